"""The process of a job: it ends with the process that started it, and within 30 seconds if it must."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from forbes.child import PARENT

__all__ = ["end", "follow", "start"]

_PATIENCE = ((signal.SIGTERM, 20.0), (signal.SIGTERM, 5.0), (signal.SIGKILL, 4.0))
"""Signals to end a process, and the seconds to wait after each; the second SIGTERM loses an agent's epoch."""


def start(command: Sequence[str], threads: int, folder: str | Path | None = None) -> subprocess.Popen[str]:
    """Start a process that gets no signal from the terminal and exits when this process does.

    Its output, stdout and stderr together, goes to a pipe.

    Args:
        command: arguments of the Python interpreter.
        threads: CPU threads of the process, unless OMP_NUM_THREADS is set.
        folder: working directory; by default that of this process.
    """
    return subprocess.Popen(
        [sys.executable, *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        cwd=folder,
        env={"OMP_NUM_THREADS": str(threads)} | os.environ | {PARENT: str(os.getpid())},
        start_new_session=True,  # Ctrl-C reaches only this process, so that each job gets one signal
    )


def follow(process: subprocess.Popen[str], say: Callable[[str], None]) -> int:
    """Pass on each line of a process that is not empty, and return its exit status."""
    with process:
        for line in process.stdout or ():
            if line.strip():
                say(line.strip())
    return process.returncode


def end(process: subprocess.Popen[str]) -> None:
    """End a process within 30 seconds: one SIGTERM, a second one for what may take minutes, then SIGKILL."""
    for number, seconds in _PATIENCE:
        if process.poll() is None:
            process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(seconds)
