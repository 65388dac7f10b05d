"""Run commands in parallel, each in its own process with an equal share of the CPU threads."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import timedelta
from types import FrameType
from typing import NamedTuple, NoReturn

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

__all__ = ["Ended", "Job", "run_jobs"]


class Job(NamedTuple):
    """One command."""

    name: str
    command: Sequence[str]
    hours: float = 1.0
    """How long it takes, relative to the other jobs, for the time that is left."""


class Ended(NamedTuple):
    """A job that has ended."""

    job: Job
    status: int
    """Exit status."""
    hours: float
    """How long it took."""
    last: str
    """Its last line."""


def run_jobs(
    jobs: Sequence[Job], at_once: int, later: float = 0.0, on_end: Callable[[Ended], None] = lambda ended: None
) -> dict[str, int]:
    """Run every command, `at_once` at a time, and return the exit statuses by name.

    A terminal shows a progress bar and the last line of each running job, and the time left for all; elsewhere all
    lines are printed, prefixed with the job's name. A job that fails does not stop the others. On Ctrl-C or SIGTERM,
    each running job gets one SIGTERM and is waited for, and no further job is started.

    Args:
        jobs: commands, with different names.
        at_once: number of processes.
        later: hours of the work that follows these jobs, counted in the time left.
        on_end: function called when a job ends, in any thread.
    """
    board = _Board(jobs, later)
    with _sigterm_raises(), board.shown(), ThreadPoolExecutor(at_once) as pool:
        running = _Running(board, max(1, (os.cpu_count() or 1) // at_once), on_end)
        try:
            found = [(job.name, pool.submit(running.run, job)) for job in jobs]
            return {name: status.result() for name, status in found}
        except BaseException:
            running.stop()
            raise  # after the pool has waited for the running jobs


class _Board:
    """Progress and last line of every running job, and the time left for all of them."""

    def __init__(self, jobs: Sequence[Job], later: float) -> None:
        self._jobs, self._later = {job.name: job for job in jobs}, later
        self._lines: dict[str, str] = {}  # of the running jobs
        self._fractions: dict[str, float] = {}  # done, of each job that has started
        self._ended = 0
        self._began = time.monotonic()
        self._lock = threading.Lock()

    def shown(self) -> AbstractContextManager[object]:
        """Return a context that shows the jobs on the terminal, if there is one."""
        self._live = Live(get_renderable=self._render, refresh_per_second=2) if sys.stdout.isatty() else None
        return self._live or nullcontext()

    def say(self, name: str, line: str) -> None:
        """Show a line of a job; "17/20" in it is its progress."""
        with self._lock:
            self._lines[name] = line
            if match := re.search(r"\b(\d+)/(\d+)\b", line):
                done, total = map(int, match.groups())
                self._fractions[name] = min(done / max(total, 1), 1.0)
            if self._live is None:
                print(f"{name}: {line}", flush=True)

    def end(self, name: str, status: int) -> None:
        """Print the exit status of a job with its last line, and the time left."""
        with self._lock:
            last = self._lines.pop(name, "")
            self._fractions[name] = 1.0
            self._ended += 1
            text = f"{name}: {'done' if status == 0 else f'ended with status {status}'}. {last}"
            if self._live is None:
                print(text, self._all_jobs(), sep="\n", flush=True)
            else:
                self._live.console.print(Text(text))

    def _all_jobs(self) -> str:
        """Return how many jobs have ended, and the time left at the pace so far."""
        done = sum(self._jobs[name].hours * fraction for name, fraction in self._fractions.items())
        left = sum(job.hours for job in self._jobs.values()) - done + self._later
        pace = (time.monotonic() - self._began) / done if done else 0.0
        about = f", about {timedelta(seconds=round(pace * left))} left" if done and left > 1e-9 else ""
        return f"{self._ended} of {len(self._jobs)} jobs have ended{about}"

    def _render(self) -> Group:
        with self._lock:
            running = Table.grid(padding=(0, 1))
            for name, line in self._lines.items():
                done = ProgressBar(1.0, self._fractions.get(name, 0.0), width=20)
                running.add_row(Text(name), done, Text(line, no_wrap=True, overflow="ellipsis"))
            return Group(running, Text(self._all_jobs()))


class _Running:
    """The processes of the jobs."""

    def __init__(self, board: _Board, threads: int, on_end: Callable[[Ended], None]) -> None:
        self.board, self.on_end, self.stopping, self.lock = board, on_end, False, threading.Lock()
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
        began, last = time.monotonic(), ""
        with process:
            self.board.say(job.name, "starts")
            for line in process.stdout or ():
                if line.strip():
                    last = line.strip()
                    self.board.say(job.name, last)
        self.board.end(job.name, process.returncode)
        self.on_end(Ended(job, process.returncode, (time.monotonic() - began) / 3600, last))
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
