"""Run commands in parallel, each in its own process with an equal share of the CPU threads."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType
from typing import NamedTuple, NoReturn

from rich.console import Group
from rich.live import Live
from rich.text import Text

__all__ = ["Job", "run_jobs"]


class Job(NamedTuple):
    """One command."""

    name: str
    command: Sequence[str]


def run_jobs(jobs: Sequence[Job], at_once: int) -> dict[str, int]:
    """Run every command, `at_once` at a time, and return the exit statuses by name.

    A terminal shows the last line of each running job; elsewhere all lines are printed, prefixed with the job's name. A
    job that fails does not stop the others. On Ctrl-C or SIGTERM, each running job gets one SIGTERM and is waited for,
    and no further job is started.
    """
    board = _Board()
    with _sigterm_raises(), board.shown(), ThreadPoolExecutor(at_once) as pool:
        running = _Running(board, threads=max(1, (os.cpu_count() or 1) // at_once))
        try:
            found = [(job.name, pool.submit(running.run, job)) for job in jobs]
            return {name: status.result() for name, status in found}
        except BaseException:
            running.stop()
            raise  # after the pool has waited for the running jobs


class _Board:
    """The last line of every running job."""

    def __init__(self) -> None:
        self._lines: dict[str, str] = {}
        self._lock = threading.Lock()

    def shown(self) -> AbstractContextManager[object]:
        """Return a context that shows the lines on the terminal, if there is one."""
        self._live = Live(get_renderable=self._render, refresh_per_second=2) if sys.stdout.isatty() else None
        return self._live or nullcontext()

    def say(self, name: str, line: str) -> None:
        """Show a line of a job."""
        with self._lock:
            self._lines[name] = line
            if self._live is None:
                print(f"{name}: {line}", flush=True)

    def end(self, name: str, status: int) -> None:
        """Print the exit status of a job, and its last line."""
        with self._lock:
            last = self._lines.pop(name, "")
            text = f"{name}: {'done' if status == 0 else f'ended with status {status}'}. {last}"
            if self._live is None:
                print(text, flush=True)
            else:
                self._live.console.print(Text(text))

    def _render(self) -> Group:
        with self._lock:
            return Group(*(Text(f"{name}: {line}", no_wrap=True) for name, line in self._lines.items()))


class _Running:
    """The processes of the jobs."""

    def __init__(self, board: _Board, threads: int) -> None:
        self.board, self.stopping, self.lock = board, False, threading.Lock()
        self.processes: list[subprocess.Popen[str]] = []
        self.environment = {"OMP_NUM_THREADS": str(threads)} | os.environ

    def run(self, job: Job) -> int:
        """Run a job to its end and return its exit status."""
        with self.lock:
            if self.stopping:
                return 128 + signal.SIGTERM
            process = subprocess.Popen(
                job.command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                env=self.environment,
                start_new_session=True,  # Ctrl-C reaches only this process, so that each job gets one signal
            )
            self.processes.append(process)
        with process:
            self.board.say(job.name, "starts")
            for line in process.stdout or ():
                if line.strip():
                    self.board.say(job.name, line.strip())
        self.board.end(job.name, process.returncode)
        return process.returncode

    def stop(self) -> None:
        """Send SIGTERM to every running job, and start no further job."""
        with self.lock:
            self.stopping = True
            for process in self.processes:
                if process.poll() is None:
                    process.terminate()


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Turn SIGTERM into an exception in the main thread, the only one that may set handlers."""
    before = signal.signal(signal.SIGTERM, _exit)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _exit(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)
