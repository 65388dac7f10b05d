"""Child processes that end with their parent: spawned ones, which ignore SIGINT and SIGTERM, and `python -m forbes`.

Nothing heavy is imported here, since a new process imports this module first.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

__all__ = ["PARENT", "exit_with_parent", "start_child"]

PARENT = "FORBES_PARENT"
"""Environment variable with the process that a new process `python -m forbes` has to follow."""
_LEFT_TO_PARENT = (signal.SIGINT, signal.SIGTERM)  # signals to the process group, which the parent handles


def start_child(serve: Callable[..., None], *arguments: Any) -> tuple[BaseProcess, Connection]:
    """Spawn a process that runs `serve(connection, *arguments)`, and return it with the other end of its connection.

    It is spawned, not forked: OpenGL contexts and torch's threads do not survive a fork.

    Args:
        serve: function at the top level of a module.
        arguments: further arguments of `serve`; must be picklable.
    """
    content = pickle.dumps((serve, arguments))
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=_run, args=(theirs,))
    resource_tracker.ensure_running()  # starting it later would unblock the signals
    with _blocked(_LEFT_TO_PARENT):  # the new process starts with them blocked, then ignores them
        process.start()
    theirs.close()  # so that the pipe is closed when the process ends
    with suppress(OSError):  # the process has died already, which the next `recv` reports
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
    """Main function of the new process. Unpickling `serve` imports its module, which may take seconds."""
    for number in _LEFT_TO_PARENT:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _LEFT_TO_PARENT)
    threading.Thread(target=_follow_parent, daemon=True).start()
    try:
        serve, arguments = connection.recv()
    except EOFError:  # the parent has exited
        return
    serve(connection, *arguments)


def _follow_parent() -> None:
    """Exit when the parent exits, even during a call that never returns."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def exit_with_parent() -> None:
    """Let this process exit at most a second after the process that the environment variable `PARENT` names, if set.

    Otherwise the training of a killed launcher would keep its run folder locked.
    """
    if parent := os.environ.pop(PARENT, None):
        threading.Thread(target=_exit_after, args=(int(parent),), daemon=True).start()


def _exit_after(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)
