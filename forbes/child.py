"""Processes of our own: they end with this one and leave signals to it, from their first moment on.

Nothing heavy is imported here, since a new process imports this module before all else.
"""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

__all__ = ["start_child"]

_LEFT_TO_PARENT = (signal.SIGINT, signal.SIGTERM)  # which gets those to the whole group, too


def start_child(serve: Callable[..., None], *arguments: Any) -> tuple[BaseProcess, Connection]:
    """Spawn a process that runs `serve(connection, *arguments)`, and return it with the other end of its connection.

    It is spawned, never forked: OpenGL contexts and the threads of torch do not survive a fork.

    Args:
        serve: of a module; what it needs is imported in the new process.
        arguments: can be pickled.
    """
    content = pickle.dumps((serve, arguments))
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=_run, args=(theirs,))
    resource_tracker.ensure_running()  # it unblocks the signals where it has to be started
    with _blocked(_LEFT_TO_PARENT):  # the new process begins with them blocked, and then ignores them
        process.start()
    theirs.close()  # so that the end of the process is the end of the pipe
    with suppress(OSError):  # it has died already, which whoever waits for an answer is told
        ours.send_bytes(content)
    return process, ours


@contextmanager
def _blocked(signals: tuple[signal.Signals, ...]) -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run(connection: Connection) -> None:
    """Run in the new process; what is received imports what it needs, which may take seconds."""
    for number in _LEFT_TO_PARENT:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _LEFT_TO_PARENT)
    threading.Thread(target=_follow_parent, daemon=True).start()
    try:
        serve, arguments = connection.recv()
    except EOFError:  # the parent is gone
        return
    serve(connection, *arguments)


def _follow_parent() -> None:
    """End with the parent, also from within a call that never returns."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
