"""Summaries of run folders: what was trained, how far, and how it went. Neither a model nor torch is loaded."""

import json
import os
import platform
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from forbes.errors import ForbesError
from forbes.reading import is_number, read_json
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.naming import method_of, task_of, with_suffix
from forbes.runs.signals import STOPPED

__all__ = ["RunSummary", "find_runs", "objective_of", "summarise"]

_OBJECTIVES = ("return/acting", "val/elbo[", "val/fivo[", "val/log_p[", "val/loss", "return/exploring")
"""Beginnings of the names of a score while training, the most telling first."""
_TAIL = 1 << 16
"""Bytes at the end of metrics.jsonl that are read: a validation is rarer than a line of training."""
_FRESH = 600.0
"""Seconds since the last line of metrics until which a run on another machine counts as running."""


class RunSummary(NamedTuple):
    """A run in one line."""

    path: Path
    method: str
    data: str
    seed: int | None
    update: int | None
    env_steps: int | None
    score: tuple[str, float] | None
    """Name and last value of the validation bound, or of an agent's return."""
    started: datetime | None
    """Time of the last start, UTC."""
    state: str
    """running, finished, stopped (by a signal; it can be resumed), failed, or unknown without a record."""
    starts: list[dict[str, Any]]
    """Entries of provenance.json."""

    @property
    def hours(self) -> float:
        """Return the hours of all starts that have ended."""
        return sum(float(entry["hours"]) for entry in self.starts if is_number(entry.get("hours")))


def find_runs(folder: Path) -> Iterator[Path]:
    """Yield the run folders in a folder, sorted; a run has config.yaml and metrics.jsonl or provenance.json."""
    for path, folders, files in os.walk(folder):
        folders.sort()
        if "config.yaml" in files and {"metrics.jsonl", "provenance.json"} & {*files}:
            folders.clear()
            yield Path(path)


def summarise(path: Path | str) -> RunSummary:
    """Read the summary of a run.

    Raises:
        ForbesError: if a file of it is missing or damaged.
    """
    run = RunFolder(path)
    if not run.config.is_file():
        raise ForbesError(f"{path}: not a run folder, config.yaml is missing. Name a folder written by `forbes fit`")
    config = read_config(run.config)
    starts = _starts(run.provenance)
    last = starts[-1] if starts else {}
    seed = last.get("seed", config.get("seed_everything"))
    metrics = _last_metrics(run.metrics)
    objective = objective_of(metrics)
    return RunSummary(
        path=run.path,
        method=with_suffix(method_of(config), str(path)),
        data=task_of(config["data"]["init_args"]),
        seed=seed if isinstance(seed, int) else None,
        update=_integer(metrics.get("update")),
        env_steps=_integer(metrics.get("env_steps")),
        score=None if objective is None else (_short(objective), float(metrics[objective])),
        started=_time(last.get("started")),
        state=_state(run, last),
        starts=starts,
    )


def objective_of(names: Any) -> str | None:
    """Return the name among those of metrics by which a run is followed, or None."""
    return next((name for start in _OBJECTIVES for name in names if name.startswith(start)), None)


def _starts(path: Path) -> list[dict[str, Any]]:
    """Return the entries of provenance.json; none for a run without it."""
    if not path.is_file():
        return []
    remedy = "Move it out of the run folder"
    entries = read_json(path, remedy)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ForbesError(f"{path}: expected a list with one entry per start. {remedy}")
    return entries


def _last_metrics(path: Path) -> dict[str, Any]:
    """Return the last value of each metric at the end of the file; a line that is cut is left out.

    A start discards the values of later updates, as in `forbes.runs.folder.read_metrics`.
    """
    if not path.is_file():
        return {}
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _TAIL))
        lines = file.read().split(b"\n")
    records: list[dict[str, Any]] = []
    for line in lines[:-1] if size <= _TAIL else lines[1:-1]:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(record, dict) or not is_number(record.get("update")):
            continue
        if record.get("start"):
            records = [known for known in records if known["update"] <= record["update"]]
        records.append(record)
    return {name: value for record in records for name, value in record.items() if is_number(value)}


def _state(run: RunFolder, last: dict[str, Any]) -> str:
    """Return the state by the last start: without an exit status it runs, or its process was killed."""
    if not last:
        return "unknown"
    status = last.get("exit_status")
    if status is not None:
        return "finished" if status == 0 else "stopped" if status in STOPPED else "failed"
    return "running" if _is_alive(run) else "failed"


def _is_alive(run: RunFolder) -> bool:
    """Return whether the process that locked a run is alive; on another machine, whether it wrote lately."""
    lock = run.path / ".lock"
    owner = re.fullmatch(r"process (\d+) on (.+)", lock.read_text(errors="replace")) if lock.is_file() else None
    if owner is None:
        return False
    if owner[2] == platform.node():
        return Path(f"/proc/{owner[1]}").exists() if Path("/proc/self").exists() else _answers(int(owner[1]))
    return run.metrics.is_file() and datetime.now(UTC).timestamp() - run.metrics.stat().st_mtime < _FRESH


def _answers(process: int) -> bool:
    """Return whether a process exists, on a system without /proc."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        return True
    return True


def _integer(value: Any) -> int | None:
    return int(value) if is_number(value) else None


def _short(name: str) -> str:
    """Return `elbo` for `val/elbo[bernoulli,S=1]`, and `return` for `return/acting`."""
    split, _, rest = name.partition("/")
    return split if split == "return" else rest.partition("[")[0]


def _time(text: Any) -> datetime | None:
    try:
        time = datetime.fromisoformat(text)
    except (TypeError, ValueError):
        return None
    return time if time.tzinfo else time.replace(tzinfo=UTC)
