"""`forbes compare --sweep`: train a grid of one configuration, and rank its points by the validation."""

import itertools
import math
import re
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.jobs import Launcher, run_jobs
from forbes.commands.trainings import Training, failures, not_finished, require_trainable, unfinished_jobs
from forbes.errors import ForbesError
from forbes.files import replace_file
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder
from forbes.runs.provenance import command_line

__all__ = ["Point", "grid", "sweep"]


class Point(NamedTuple):
    """A point of the grid."""

    name: str
    """Name of its run folders, without the seed."""
    values: dict[str, str]
    """Values by key, as given."""

    @property
    def flags(self) -> tuple[str, ...]:
        """Flags of `forbes fit` that set the values."""
        return tuple(f"--{key}={value}" for key, value in self.values.items())


def sweep(config: str, keys: Sequence[str], flags: Sequence[str], seeds: int, folder: Path, launcher: Launcher) -> None:
    """Train every point with every seed, and print the table of the best validations and the best point.

    Args:
        config: configuration.
        keys: `KEY=V1,V2` of each swept key.
        flags: further flags of `forbes fit`.
        seeds: number of seeds.
        folder: output folder.
        launcher: where the trainings run.

    Raises:
        ForbesError: if a key or value is wrong, before anything is trained; or if a training failed, at the end.
    """
    points = grid(config, keys)
    first = points[0].values
    for point in points:
        if sum(point.values[key] != first[key] for key in first) <= 1:  # every value is in one of them
            require_trainable(config, (*flags, *point.flags))
    runs = {point.name: [str(folder / f"{point.name}-{seed}") for seed in range(seeds)] for point in points}
    trainings = [
        Training(config, (*flags, *point.flags), seed, runs[point.name][seed])
        for seed, point in itertools.product(range(seeds), points)
    ]
    failed = failures(run_jobs(unfinished_jobs(trainings), launcher))
    rows = [_row(point, [run for run in runs[point.name] if run not in failed]) for point in points]
    table = _ranked(pd.DataFrame([row for row in rows if row]))
    if len(table):
        replace_file(folder / "sweep.csv", table.to_csv(index=False).encode())
        _print(table, [*first])
        best = next(point for point in points if point.name == table["name"].iloc[0])
        print(f"best: {command_line('fit', config, *flags, *best.flags)}")
        print(f"sweep.csv is in {folder}")
    if failed:
        raise not_finished(failed, len(trainings))


def grid(config: str, keys: Sequence[str]) -> list[Point]:
    """Return the points of a grid.

    Raises:
        ForbesError: for a key without values, or two points of the same name.
    """
    values = dict(map(_parsed, keys))
    if len(values) < len(keys):
        raise ForbesError(f"--sweep: a key is given twice in {' '.join(keys)}. Give all its values at once: KEY=V1,V2")
    shorts = [key.rpartition(".")[2] for key in values]
    names = [short if shorts.count(short) == 1 else key for short, key in zip(shorts, values, strict=True)]
    points = []
    for chosen in itertools.product(*values.values()):
        parts = [f"{name}={_plain(value)}" for name, value in zip(names, chosen, strict=True)]
        points.append(Point(",".join([Path(config).stem, *parts]), dict(zip(values, chosen, strict=True))))
    found = [point.name for point in points]
    if twice := next((name for name in found if found.count(name) > 1), None):
        raise ForbesError(f"--sweep: two points of the grid are called {twice}. Remove or change one of the values")
    return points


def _plain(value: str) -> str:
    """Return a value as a part of a folder's name."""
    return re.sub(r"[^\w.+-]+", "_", value)


def _parsed(sweep: str) -> tuple[str, list[str]]:
    """Split `KEY=V1,V2`, but not at commas inside brackets or quotes."""
    key, _, values = sweep.lstrip("-").partition("=")
    found, depth, quote = [""], 0, ""
    for letter in values:
        if letter == "," and depth == 0 and not quote:
            found.append("")
            continue
        found[-1] += letter
        if letter in "\"'":
            quote = "" if letter == quote else quote or letter
        elif not quote:
            depth += (letter in "[{(") - (letter in "]})")
    if not key or not all(found) or depth or quote:
        raise ForbesError(f"--sweep {sweep}: expected KEY=V1,V2, e.g. model.learning_rate=1e-3,3e-3")
    return key, found


def _row(point: Point, runs: Sequence[str]) -> dict[str, Any] | None:
    """Return the best validations of a point's runs; None without runs."""
    if not runs:
        return None
    bests = [read_checkpoint(RunFolder(run).checkpoint).get("best", {}) for run in runs]
    if not all(bests):
        raise ForbesError(f"{runs[0]}: has no validation to rank it by. Validate: --trainer.limit_val_batches 1.0")
    values = [best["value"] for best in bests]
    error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return {
        "name": point.name,
        **point.values,
        "metric": bests[0]["metric"],
        "mean": statistics.mean(values),
        "standard_error": error,
        "seeds": len(values),
        "updates": ", ".join(str(best["update"]) for best in bests),
    }


def _ranked(table: pd.DataFrame) -> pd.DataFrame:
    """Sort the points, the best first.

    Raises:
        ForbesError: if they are not validated by the same metric.
    """
    metrics = table["metric"].unique() if len(table) else []
    if len(metrics) > 1:
        raise ForbesError(f"--sweep: {' and '.join(metrics)} cannot be ranked. Sweep over keys that keep the metric")
    return table.sort_values("mean", ascending=metrics[0].endswith("/loss")) if len(metrics) else table


def _print(table: pd.DataFrame, keys: Sequence[str]) -> None:
    """Print the table."""
    shown = Table(title=f"best {table['metric'].iloc[0]} of each run, over seeds")
    for header in (*keys, "mean ± s.e.", "seeds", "at update"):
        shown.add_column(header, overflow="fold")
    for row in table.to_dict("records"):
        error = "" if math.isnan(row["standard_error"]) else f" ± {row['standard_error']:.3g}"
        shown.add_row(*(row[key] for key in keys), f"{row['mean']:.6g}{error}", str(row["seeds"]), row["updates"])
    console(200).print(shown)
