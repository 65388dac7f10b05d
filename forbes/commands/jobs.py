"""Run a list of jobs with a launcher, repeat those that crashed, and say how each one ended."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from signal import SIGTERM, signal
from types import FrameType
from typing import NamedTuple, NoReturn, Protocol

from forbes.commands.board import Board
from forbes.errors import ForbesError
from forbes.runs.folder import RunFolder
from forbes.runs.signals import STOPPED

__all__ = ["ATTEMPTS", "Ended", "Job", "Launcher", "checkpoint_time", "run_jobs"]

ATTEMPTS = 3
"""A job is given up when it has crashed so many times in a row without a new checkpoint."""
_FINAL = {0, 2, 3} | STOPPED
"""Exit statuses that a repeat would not change: finished, an error that the user can fix, a divergence, a signal."""


class Job(NamedTuple):
    """One command. The launcher decides where it runs."""

    name: str
    command: Sequence[str]
    """Arguments of the Python interpreter."""
    hours: float = 1.0
    """How long it takes, relative to the other jobs, for the time that is left."""
    run: str = ""
    """Run folder of a training, whose checkpoint the job resumes from; empty for other commands."""
    resume: Sequence[str] = ()
    """The command if the run has a checkpoint."""
    refused: str = ""
    """Why it must not be run, if so."""

    def current(self) -> Sequence[str]:
        """Return the command that starts the job, or resumes it from the checkpoint that the run has now."""
        return self.resume if self.run and RunFolder(self.run).checkpoint.exists() else self.command


class Ended(NamedTuple):
    """A job that has ended."""

    job: Job
    status: int
    """Exit status of the last attempt."""
    hours: float
    """How long all attempts took."""
    last: str
    """Last line of its output."""
    attempts: int = 1
    """Number of attempts since the last new checkpoint."""

    @property
    def reason(self) -> str:
        """Return why the job is not finished."""
        if self.status in STOPPED:
            return "was interrupted"
        times = f" {self.attempts} times" if self.attempts > 1 else ""
        refused = self.job.refused.removeprefix(f"{self.job.name}: ")
        return refused or f"ended{times} with status {self.status}: {self.last}"


class Launcher(Protocol):
    """Where jobs run: processes of this machine, or of a cluster."""

    at_once: int
    """Number of jobs that are waited for at the same time."""

    def ready(self, jobs: Sequence[Job]) -> AbstractContextManager[object]:
        """Return a context in which these jobs can be attempted."""

    def attempt(self, job: Job, say: Callable[[str], None]) -> int:
        """Start or resume a job, wait for its end, and return its exit status.

        It is called in a thread per job.

        Args:
            job: job to run.
            say: function that shows a line of its output.

        Raises:
            ForbesError: if it cannot be run. It ends like a job with status 2, and the others go on.
        """

    def stop(self) -> None:
        """End all running jobs within 30 seconds. It is called once, and no attempt follows."""


def run_jobs(
    jobs: Sequence[Job], launcher: Launcher, later: float = 0.0, on_end: Callable[[Ended], None] = lambda ended: None
) -> list[Ended]:
    """Run every job, and return how each one ended.

    A terminal shows a progress bar and the last line of each running job, and the time left for all; elsewhere all
    lines are printed, prefixed with the job's name. A job that fails does not stop the others. One that crashes, or
    whose machine is lost, is begun again from its checkpoint, until it has crashed `ATTEMPTS` times in a row without a
    new one. Errors that the user must fix (status 2) and divergences (status 3) are not repeated. On Ctrl-C or SIGTERM
    all jobs are stopped within 30 seconds, and no further job is started.

    Args:
        jobs: jobs with different names.
        launcher: where they run.
        later: hours of the work that follows these jobs, counted in the time left.
        on_end: function called when a job ends, in any thread.
    """
    if not jobs:
        return []
    board = Board({job.name: job.hours for job in jobs}, later)
    allowed = [job for job in jobs if not job.refused]
    with (
        _sigterm_raises(),
        launcher.ready(allowed) if allowed else nullcontext(),
        board.shown(),
        ThreadPoolExecutor(launcher.at_once) as pool,
    ):
        running = _Running(board, launcher, on_end)
        try:
            found = [pool.submit(running.run, job) for job in jobs]
            return [ended.result() for ended in found]
        except BaseException:
            running.stop()
            raise  # after the pool has waited for the running jobs


class _Running:
    """The attempts of the jobs."""

    def __init__(self, board: Board, launcher: Launcher, on_end: Callable[[Ended], None]) -> None:
        self.board, self.launcher, self.on_end, self.stopping = board, launcher, on_end, threading.Event()

    def run(self, job: Job) -> Ended:
        """Run a job to its end."""
        if self.stopping.is_set():
            return Ended(job, -SIGTERM, 0.0, "")
        began, status, attempts = time.monotonic(), 2, 0
        if job.refused:
            self.board.say(job.name, job.refused)
        else:
            status, attempts = self._attempts(job)
        last = self.board.end(job.name, status)
        ended = Ended(job, status, (time.monotonic() - began) / 3600, last, attempts)
        self.on_end(ended)
        return ended

    def _attempts(self, job: Job) -> tuple[int, int]:
        """Repeat a job that crashes; return its last exit status and the number of attempts without progress."""
        attempts = 0
        while True:
            before = checkpoint_time(job)
            try:
                status = self.launcher.attempt(job, lambda line: self.board.say(job.name, line))
            except ForbesError as error:
                self.board.say(job.name, f"forbes: {error}")
                status = 2
            attempts = attempts + 1 if checkpoint_time(job) == before else 1
            if status in _FINAL or attempts == ATTEMPTS or self.stopping.is_set():
                return status, attempts
            self.board.note(f"{job.name}: ended with status {status}, begins again (attempt {attempts + 1})")

    def stop(self) -> None:
        """Stop the running jobs, and start no further job."""
        self.stopping.set()
        self.launcher.stop()


def checkpoint_time(job: Job) -> int:
    """Return when the checkpoint of a job was written, in ns; 0 if there is none."""
    checkpoint = RunFolder(job.run).checkpoint if job.run else None
    return checkpoint.stat().st_mtime_ns if checkpoint is not None and checkpoint.exists() else 0


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Turn SIGTERM into an exception in the main thread, the only one that may set handlers."""
    before = signal(SIGTERM, _exit)
    try:
        yield
    finally:
        signal(SIGTERM, before)


def _exit(number: int, frame: FrameType | None) -> NoReturn:
    sys.exit(128 + number)
