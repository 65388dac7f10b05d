"""What `forbes compare` and `forbes reproduce` show of their jobs: progress, last lines, and the time left."""

import re
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from datetime import timedelta

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

__all__ = ["Board"]

_PROGRESS = re.compile(r"(?:^epoch|  update|:) (\d+)/(\d+)\b")
"""How far a job is; the seed episodes of an agent are only its beginning."""


class Board:
    """Progress and last line of every running job, and the time left for all of them.

    Args:
        hours: expected hours of each job, by name.
        later: hours of the work that follows.
    """

    def __init__(self, hours: Mapping[str, float], later: float) -> None:
        self._hours, self._later = hours, later
        self._lines: dict[str, str] = {}  # of the running jobs
        self._fractions: dict[str, float] = {}  # done, of each job that has started
        self._earlier: dict[str, float] = {}  # done by an earlier command, of each job that tells its progress
        self._ended = 0
        self._began = time.monotonic()
        self._lock = threading.Lock()

    def shown(self) -> AbstractContextManager[object]:
        """Return a context that shows the jobs on the terminal, if there is one."""
        self._live = Live(get_renderable=self._render, refresh_per_second=2) if sys.stdout.isatty() else None
        return self._live or nullcontext()

    def say(self, name: str, line: str) -> None:
        """Show a line of a job; its progress is in "epoch 17/20", "update 170/200" or "elbo: 17/20 sequences"."""
        with self._lock:
            self._lines[name] = line
            if match := _PROGRESS.search(line):
                done, total = int(match[1]), max(int(match[2]), 1)
                self._fractions[name] = min(done / total, 1.0)
                self._earlier.setdefault(name, min((done - 1) / total, 1.0))
            if self._live is None:
                print(f"{name}: {line}", flush=True)

    def note(self, line: str) -> None:
        """Print a line that stays."""
        with self._lock:
            self._print(line)

    def end(self, name: str, status: int) -> str:
        """Print the exit status of a job with its last line, and the time left; return that line."""
        with self._lock:
            last = self._lines.pop(name, "")
            self._fractions[name] = 1.0
            self._ended += 1
            self._print(f"{name}: {'done' if status == 0 else f'ended with status {status}'}. {last}")
            if self._live is None:
                print(self._all_jobs(), flush=True)
            return last

    def _print(self, line: str) -> None:
        if self._live is None:
            print(line, flush=True)
        else:
            self._live.console.print(Text(line))

    def _all_jobs(self) -> str:
        """Return how many jobs have ended, and the time left at the pace so far."""
        hours = self._hours
        left = sum(hours.values()) - sum(hours[name] * done for name, done in self._fractions.items()) + self._later
        here = sum(hours[name] * (done - self._earlier.get(name, 0.0)) for name, done in self._fractions.items())
        pace = (time.monotonic() - self._began) / here if here else 0.0
        about = f", about {timedelta(seconds=round(pace * left))} left" if here and left > 1e-9 else ""
        return f"{self._ended} of {len(self._hours)} jobs have ended{about}"

    def _render(self) -> Group:
        with self._lock:
            running = Table.grid(padding=(0, 1))
            for name, line in self._lines.items():
                done = ProgressBar(1.0, self._fractions.get(name, 0.0), width=20)
                running.add_row(Text(name), done, Text(line, no_wrap=True, overflow="ellipsis"))
            return Group(running, Text(self._all_jobs()))
