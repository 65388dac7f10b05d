"""Jobs as an array of SLURM jobs, submitted by submitit and queued again when they are preempted or their time is over.

A job is stopped at an update, with a checkpoint, and resumes from it when it runs again. Run folders, configurations
and this Python must be in a file system that the nodes share.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import submitit
from submitit.core.utils import DelayedSubmission, FailedJobError, FailedSubmissionError, UncompletedJobError

from forbes.commands.jobs import Job
from forbes.commands.launchers.process import follow, start
from forbes.errors import ForbesError
from forbes.files import replace_file
from forbes.reading import read_json
from forbes.runs.signals import STOPPED

__all__ = ["Slurm"]

_POLL = 2.0  # seconds
_WAITED_FOR = 256  # jobs that are looked at; SLURM limits those that run
_ACTIVE = ("PENDING", "RUNNING", "REQUEUED", "PREEMPTED", "COMPLETING", "CONFIGURING", "SUSPENDED")
_TIMEOUTS = 1000  # times that a job whose time is over is queued again
_OURS = {"time": 60, "signal_delay_s": 120}
"""Options that submitit must know, with their defaults: minutes of a job, and seconds from the signal to the end."""


class Slurm:
    """Runs jobs on a SLURM cluster.

    The jobs outlive this process: if it is killed, the same command waits for them instead of submitting them again.

    Args:
        folder: folder for logs, shared by the nodes.
        options: `KEY=VALUE` of sbatch.
        at_once: largest number of jobs that run at the same time.
    """

    def __init__(self, folder: Path, options: Sequence[str], at_once: int) -> None:
        self.at_once = _WAITED_FOR
        self._record = folder / "slurm" / "jobs.json"
        self._executor = _executor(folder / "slurm", _parsed(options), at_once)
        self._lock, self._stopping = threading.Lock(), False
        self._numbers: dict[str, str] = {}  # of all jobs that were ever submitted, by name
        self._known: dict[str, Any] = {}  # submitted jobs that have not ended, by name

    @contextmanager
    def ready(self, jobs: Sequence[Job]) -> Iterator[None]:
        """Submit the jobs that are neither queued nor running since an earlier command."""
        self._numbers = read_json(self._record, "Delete it") if self._record.is_file() else {}
        for job in jobs:
            if number := self._numbers.get(job.name):
                handle = self._executor.job_class(self._executor.folder, number)
                if handle.state.split(" ")[0] in _ACTIVE:
                    self._known[job.name] = handle
        self._submit([job for job in jobs if job.name not in self._known])
        yield

    def attempt(self, job: Job, say: Callable[[str], None]) -> int:
        """Wait for the end of a job, which is submitted again after the first attempt."""
        with self._lock:
            if self._stopping:
                return -signal.SIGTERM
            if job.name not in self._known:
                self._submit([job])
            handle = self._known[job.name]
        shown = ""
        while not self._is_done(handle):
            if (line := _last_line(handle.paths.stdout)) not in ("", shown):
                say(shown := line)
            time.sleep(_POLL)
        status, last = self._result(handle)
        say(last)
        with self._lock:
            self._known.pop(job.name, None)
        return status

    def stop(self) -> None:
        """Cancel all jobs. SLURM sends them SIGTERM, and SIGKILL after its KillWait, 30 seconds by default."""
        with self._lock:
            self._stopping = True
            for handle in self._known.values():
                handle.cancel(check=False)

    def _submit(self, jobs: Sequence[Job]) -> None:
        """Submit jobs as an array, and record their numbers.

        Raises:
            ForbesError: if SLURM refuses them.
        """
        if not jobs:
            return
        try:
            handles = self._executor.submit_array([_Work(job) for job in jobs])
        except (FailedJobError, FailedSubmissionError) as error:
            reason = next((line for line in str(error).splitlines() if line.strip()), "no reason given")
            raise ForbesError(f"--launcher slurm: SLURM refuses the jobs ({reason}). Change --slurm") from error
        self._known |= {job.name: handle for job, handle in zip(jobs, handles, strict=True)}
        self._numbers |= {job.name: handle.job_id for job, handle in zip(jobs, handles, strict=True)}
        replace_file(self._record, json.dumps(self._numbers, indent=2).encode() + b"\n")

    def _is_done(self, handle: Any) -> bool:
        with self._lock:  # submitit asks SLURM for all jobs at once
            return self._stopping or handle.done()

    def _result(self, handle: Any) -> tuple[int, str]:
        """Return the exit status of a job, and its last line."""
        if self._stopping:
            return -signal.SIGTERM, "cancelled"
        try:
            status, last = handle.result()
        except UncompletedJobError as error:
            state = handle.state.split(" ")[0]
            line = _last_line(handle.paths.stderr) or str(error).splitlines()[0]
            return (-signal.SIGTERM if state == "CANCELLED" else 1), f"{state}: {line}"
        return status, last


class _Work:
    """What submitit runs on a node: a job, whose `checkpoint` is called before it is queued again."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self._process: subprocess.Popen[str] | None = None

    def __call__(self) -> tuple[int, str]:
        """Run the job, and return its exit status and last line.

        SIGUSR1 and SIGUSR2 stop the job, which is then queued again by submitit. SIGTERM stops it only, since it comes
        from `scancel` too, and SLURM itself queues preempted jobs again. Then there is no result.
        """
        requeue = signal.getsignal(getattr(signal, f"SIG{os.environ.get('SUBMITIT_PREEMPT_SIGNAL', 'USR2')}"))
        for number in (signal.SIGUSR1, signal.SIGUSR2):
            signal.signal(number, requeue)
        signal.signal(signal.SIGTERM, self._pass_on)
        self._process = start(self.job.current(), int(os.environ.get("SLURM_CPUS_PER_TASK", "1")))
        lines = [""]

        def say(line: str) -> None:
            lines[0] = line
            print(line, flush=True)

        status = follow(self._process, say)
        if status in STOPPED:
            sys.exit(abs(status))
        return status, lines[0]

    def checkpoint(self) -> DelayedSubmission:
        """Stop the job at an update, with a checkpoint, and return what is queued again."""
        self._pass_on(signal.SIGUSR1, None)
        if self._process:
            with suppress(ChildProcessError):  # it has ended already
                os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)  # unlike `wait`, without a lock
        return DelayedSubmission(_Work(self.job))

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        """Stop the job, by a signal that does not count as a second one if SLURM has sent SIGTERM to all processes."""
        if self._process:
            self._process.send_signal(signal.SIGUSR1)


def _parsed(options: Sequence[str]) -> dict[str, str]:
    """Return options by name.

    Raises:
        ForbesError: for an option without a value, or a time that is not in minutes.
    """
    found = {}
    for option in options:
        key, given, value = option.strip("-").partition("=")
        if not given or not value:
            raise ForbesError(f"--slurm {option}: expected KEY=VALUE of sbatch, e.g. partition=gpu")
        found[key.replace("-", "_")] = value
    for key in _OURS:
        if not found.get(key, "1").isdigit():
            unit = "seconds" if key.endswith("_s") else "minutes"
            raise ForbesError(f"--slurm {key}={found[key]}: expected a whole number of {unit}")
    return found


def _executor(folder: Path, options: dict[str, str], at_once: int) -> Any:
    """Return what submits jobs.

    Raises:
        ForbesError: on a machine without SLURM.
    """
    try:
        executor = submitit.SlurmExecutor(folder=folder, max_num_timeout=_TIMEOUTS)
    except RuntimeError as error:
        raise ForbesError(
            "--launcher slurm: srun is missing here. Run the command on a machine of the cluster"
        ) from error
    ours = {key: int(options.pop(key, default)) for key, default in _OURS.items()}
    cpus = options.get("cpus_per_task")  # since SLURM 22.05, srun has one CPU unless it is told again
    executor.update_parameters(
        job_name="forbes",
        array_parallelism=at_once,
        srun_args=[f"--cpus-per-task={cpus}"] if cpus else [],
        wckey=None,
        additional_parameters={"requeue": True, **options},
        **ours,
    )
    return executor


def _last_line(path: Path) -> str:
    """Return the last line of a log that is not empty."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 4096))
        lines = [line.strip() for line in file.read().decode(errors="replace").splitlines()]
    return next((line for line in reversed(lines) if line), "")
