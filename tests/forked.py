"""Run a function in a fork of the test's process, so that it can be killed."""

import gc
import multiprocessing
from collections.abc import Callable

__all__ = ["run_in_a_fork"]


def run_in_a_fork(function: Callable[..., object], *arguments: object) -> int | None:
    """Return the exit code of a process that calls a function."""
    process = multiprocessing.get_context("fork").Process(target=_call, args=(function, *arguments))
    process.start()
    process.join()
    return process.exitcode


def _call(function: Callable[..., object], *arguments: object) -> None:
    """Leave what earlier tests left to the parent: a decoder of a video that goes waits for threads not forked."""
    gc.freeze()
    function(*arguments)
