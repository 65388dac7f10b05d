"""Jobs as processes of this machine, each with an equal share of the CPU threads."""

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

from forbes.commands.jobs import Job
from forbes.commands.launchers.process import end, follow, start

__all__ = ["Local", "num_cpus"]


class Local:
    """Runs jobs on this machine.

    Args:
        at_once: number of processes.
    """

    def __init__(self, at_once: int) -> None:
        self.at_once = at_once
        self._threads = max(1, num_cpus() // at_once)
        self._lock, self._stopping = threading.Lock(), False
        self._processes: list[subprocess.Popen[str]] = []

    def ready(self, jobs: Sequence[Job]) -> AbstractContextManager[object]:
        """Return an empty context."""
        return nullcontext()

    def attempt(self, job: Job, say: Callable[[str], None]) -> int:
        """Run a job as a process, and return its exit status."""
        with self._lock:
            if self._stopping:
                return -signal.SIGTERM
            process = start(job.current(), self._threads)
            self._processes.append(process)
        say("starts")
        return follow(process, say)

    def stop(self) -> None:
        """End all processes, and start no further one."""
        with self._lock:
            self._stopping = True
        for process in self._processes:
            threading.Thread(target=end, args=(process,)).start()


def num_cpus() -> int:
    """Return how many CPUs this process may use: those of a job of SLURM or a container, not of the whole machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
