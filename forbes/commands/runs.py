"""`forbes runs`: a table of run folders, and the curves of one of them in the terminal."""

import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.curves import curve
from forbes.commands.parsers.runs import parser
from forbes.errors import ForbesError
from forbes.reading import is_number, read_json
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.summary import RunSummary, find_runs, objective_of, summarise

__all__ = ["main"]

_WIDTH = 80
_STYLES = {"running": "green", "failed": "red", "stopped": "yellow"}
_UNITS = (("d", 86400), ("h", 3600), ("min", 60))


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    what = parser().parse_args(argv).what
    if what[:1] == ["show"]:
        if len(what) != 2:
            raise ForbesError("forbes runs show: expected one run. Name it: forbes runs show RUN")
        return _show(what[1])
    if len(what) > 1:
        raise ForbesError(f"forbes runs: expected one folder, got {' '.join(what)}. Name one, or: forbes runs show RUN")
    _list(Path(what[0] if what else "runs"))


def _list(folder: Path) -> None:
    """Print the table of the runs below a folder; of a damaged one, a sentence to stderr."""
    if not folder.is_dir():
        raise ForbesError(f"{folder}: no such folder. `forbes fit` creates runs/; name another: forbes runs DIR")
    found: list[RunSummary] = []
    damaged: list[str] = []
    for path in find_runs(folder):
        try:
            found.append(summarise(path))
        except ForbesError as error:
            damaged.append(str(error))
    if found:
        console(_WIDTH).print(_table(found, folder))
    else:
        print(f"{folder}: no runs")
    for sentence in damaged:
        print(f"forbes: {sentence}", file=sys.stderr)


def _table(runs: Sequence[RunSummary], folder: Path) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    agents = any(run.env_steps is not None for run in runs)
    for header in ("run", "method", "data"):
        table.add_column(header, overflow="fold")
    for header in ("seed", "updates", *(["env steps"] if agents else []), "score", "age"):
        table.add_column(header, justify="right", no_wrap=True)
    table.add_column("state", no_wrap=True)
    for run in runs:
        name = "." if run.path == folder else str(run.path.relative_to(folder))
        style = _STYLES.get(run.state, "")
        table.add_row(
            *map(escape, (name, run.method, run.data)),
            *map(_count, (run.seed, run.update, *([run.env_steps] if agents else []))),
            "" if run.score is None else f"{run.score[0]} {_value(run.score[1])}",
            _age(run.started),
            f"[{style}]{run.state}[/{style}]" if style else run.state,
        )
    return table


def _show(path: str) -> None:
    """Print what a run is, its curves and its recorded scores."""
    run = summarise(path)
    screen = console(_WIDTH)
    last = run.starts[-1] if run.starts else {}
    more = len(run.starts) > 1
    facts: dict[str, Any] = {
        "run": run.path,
        "method": f"{run.method} on {run.data}, seed {_count(run.seed)}",
        "state": f"{run.state}, {_count(run.update)} updates in {run.hours:.2f} hours",
        "started": (f"{_age(run.started)} ago" if run.started else "unknown") + f", {len(run.starts)} starts" * more,
        "commit": last.get("commit", "unknown"),
        "command": last.get("command", "unknown"),
    }
    for name, value in facts.items():
        screen.print(f"{name:<8} {escape(str(value))}", soft_wrap=True, highlight=False)
    if RunFolder(path).metrics.is_file():
        metrics = read_metrics(path)
        for name in _curves(list(metrics)):
            of_one = metrics[name].dropna()
            print(f"\n{name}, by update; last {_value(float(of_one.iloc[-1]))}")
            print(*curve(of_one.index.tolist(), of_one.tolist(), _WIDTH), sep="\n")
    if scores := _recorded(RunFolder(path).results / "evaluation.json"):
        print("\nrecorded scores, mean ± standard error")
        width = max(map(len, scores))
        for name, text in scores.items():
            print(f"{name:<{width}}  {text}" if width + len(text) < _WIDTH - 2 else f"{name}\n    {text}")


def _curves(names: list[str]) -> list[str]:
    """Return the metrics to draw: what the run is followed by, what it trains on, and its KL."""
    chosen = objective_of(names)
    bounds = ("train/elbo[", "train/fivo[", "train/log_p[", "train/loss")
    trained = next((name for name in names if name.startswith(bounds)), None)
    divergence = next((name for name in ("val/kl", "train/kl") if name in names), None)
    return [name for name in dict.fromkeys((chosen, trained, divergence)) if name]


def _recorded(path: Path) -> dict[str, str]:
    """Return the scores in evaluation.json, as text by name."""
    if not path.is_file():
        return {}
    record = read_json(path, "Delete it and evaluate again")
    if not isinstance(record, dict):
        raise ForbesError(f"{path}: holds a {type(record).__name__}, expected entries by metric. Delete it")
    found = {}
    for name, entry in record.items():
        if isinstance(entry, dict) and is_number(entry.get("mean")):
            error = entry.get("standard_error")
            found[name] = _value(entry["mean"]) + (f" ± {error:.2f}" if is_number(error) else "")
    return found


def _count(value: int | None) -> str:
    return "" if value is None else f"{value:,}"


def _value(value: float) -> str:
    return f"{value:.{1 if abs(value) >= 100 else 2}f}"


def _age(started: datetime | None) -> str:
    """Return the time since then in its largest unit, e.g. 3 h."""
    if started is None:
        return ""
    seconds = (datetime.now(UTC) - started).total_seconds()
    for unit, size in _UNITS:
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(0, seconds):.0f} s"
