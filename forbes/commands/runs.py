"""`forbes runs`: a table of run folders, and the curves of one of them in the terminal."""

import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from rich import box
from rich.cells import cell_len
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
_LEFT_OUT = ("age", "seed", "updates", "data", "method")
"""Columns that a narrow terminal does not show, in this order: the name of a run is what identifies it."""
_FOLDED = 12
"""Width of method and data, below which they are left out instead of folded."""
_GAP = 2
"""Blank columns after a cell."""
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
        _print_tables(found, folder)
    else:
        print(f"{folder}: no runs")
    for sentence in damaged:
        print(f"forbes: {sentence}", file=sys.stderr)


def _print_tables(runs: Sequence[RunSummary], folder: Path) -> None:
    """Print a table of the runs without env steps, and one of those with them, which have a column more."""
    screen, hidden = console(_WIDTH), dict[str, None]()
    for acting in (False, True):
        rows = [_row(run, folder) for run in runs if acting == (run.env_steps is not None)]
        if not rows:
            continue
        widths = _widths(rows, screen.width)
        screen.print(_table(rows, widths))
        hidden |= dict.fromkeys(name for name in _LEFT_OUT if name not in widths)
    if hidden:
        print(f"no room in {screen.width} columns: {', '.join(hidden)}")


def _row(run: RunSummary, folder: Path) -> dict[str, str]:
    """Return the cells of a run by the name of their column."""
    acted = {} if run.env_steps is None else {"env steps": _count(run.env_steps)}
    return {
        "run": "." if run.path == folder else str(run.path.relative_to(folder)),
        "method": run.method,
        "data": run.data,
        "seed": _count(run.seed),
        "updates": _count(run.update),
        **acted,
        "score": "" if run.score is None else f"{run.score[0]} {_value(run.score[1])}",
        "age": _age(run.started),
        "state": run.state,
    }


def _widths(rows: Sequence[dict[str, str]], width: int) -> dict[str, int]:
    """Return the columns to show and their widths, so that names of runs are folded only where nothing else is left."""
    whole = {name: max(cell_len(name), *(cell_len(row[name]) for row in rows)) for name in rows[0]}
    shown = whole | {name: min(whole[name], _FOLDED) for name in ("method", "data")}

    def room() -> int:
        return width - sum(shown.values()) - _GAP * len(shown)

    for name in _LEFT_OUT:
        if room() < 0:
            del shown[name]
    for name in ("method", "data"):
        if name in shown:
            shown[name] = min(whole[name], shown[name] + room())
    shown["run"] += min(0, room())
    return shown


def _table(rows: Sequence[dict[str, str]], widths: dict[str, int]) -> Table:
    """Return the table. What is longer than its column is folded."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, _GAP - 1, 0, 0))
    for name, width in widths.items():
        justify: Literal["left", "right"] = "left" if name in ("run", "method", "data", "state") else "right"
        table.add_column(name, justify=justify, width=width, overflow="fold")
    for row in rows:
        cells = {name: escape(row[name]) for name in widths}
        if style := _STYLES.get(row["state"]):
            cells["state"] = f"[{style}]{row['state']}[/{style}]"
        table.add_row(*cells.values())
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
            ended = f"; last {_value(float(of_one.iloc[-1]))}" if len(of_one) else ""
            print(f"\n{name}, by update{ended}")
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
