"""Published results to compare with: single numbers, which are bundled, and learning curves, which are fetched.

`data/published.csv` has one number per row: task, method, env_steps (simulator frames), metric, value, unit, seeds
(empty if not published), source and note. Nothing in it is read off a picture. The rows of Dreamer are computed from
its authors' curves by `at_step`; all others are copied.
"""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from forbes.bundled import bundled
from forbes.data.download import curves_paths
from forbes.errors import ForbesError
from forbes.reading import read_json, readable

__all__ = ["SPREAD", "at_step", "published_curves", "published_numbers", "published_path", "published_returns"]

_BIN = 10_000
"""Env steps that are one point of a curve: DreamerV3's has eight episodes after every 8,000."""

SPREAD = "return, standard deviation over seeds"
"""Metric of the spread of a published return."""


def published_path() -> Path:
    """Return the path of the bundled table."""
    return bundled("published.csv")


def published_numbers() -> pd.DataFrame:
    """Read the published numbers.

    Raises:
        ForbesError: if the file is missing or damaged.
    """
    path, remedy = published_path(), "Restore it from the repository, or reinstall forbes"
    if not path.is_file():
        raise ForbesError(f"{path}: no such file. {remedy}")
    with readable(path, "a table of published numbers", remedy):
        table = pd.read_csv(path)
        table["value"] = table["value"].astype(float)
    return table


def published_returns(task: str) -> pd.DataFrame:
    """Return the published returns of a task: one row per method and step, `spread` is NaN if unknown."""
    table = published_numbers()
    table = table[table["task"] == task]
    columns = ["method", "env_steps"]
    spread = table[table["metric"] == SPREAD].set_index(columns)["value"].rename("spread")
    return table[table["metric"] == "return"].join(spread, on=columns).reset_index(drop=True)


def at_step(curves: Sequence[pd.Series], step: float) -> tuple[float, float]:
    """Return the mean and standard deviation over seeds of published curves, each at its point nearest to a step.

    A point of the curves of danijar/dreamer at 505,000 env steps is the mean of the evaluations in the 100,000 before.
    """
    values = pd.Series([curve.iloc[abs(curve.index.to_numpy() - step).argmin()] for curve in curves])
    return float(values.mean()), float(values.std())


def published_curves(path: str | None, task: str) -> dict[str, list[pd.Series]]:
    """Read the published curves of a task: returns against env steps by method, one per seed.

    The episodes within 10,000 env steps are one point, their mean.

    Args:
        path: file with a JSON list of `{"task": …, "method": …, "seed": …, "xs": [env steps], "ys": [returns]}`, as
            published by the authors of Dreamer; their task names may begin with `dmc_`. None for the files of
            `forbes data fetch curves`, which give no curves if they are missing or lack the task.
        task: name of the task, e.g. `cartpole_swingup`.

    Raises:
        ForbesError: if a file is invalid, or a file given by `path` lacks the task.
    """
    remedy = "Name another, or none"
    if path and not Path(path).is_file():
        raise ForbesError(f"{path}: no such file. {remedy}")
    files = [Path(path)] if path else [file for file in curves_paths() if file.is_file()]
    names = {task, f"dmc_{task}", f"dmc_{task.removeprefix('ball_in_')}"}  # Dreamer calls ball_in_cup_catch cup_catch
    curves: dict[str, list[pd.Series]] = {}
    known = set()
    for file in files:
        found = read_json(file, remedy)
        with readable(file, "a file of curves, expected a JSON list of task, method, seed, xs and ys", remedy):
            for one in found:
                known.add(one["task"])
                if one["task"] in names:
                    curves.setdefault(one["method"], []).append(_points(one["xs"], one["ys"]))
    if path and not curves:
        listed = ", ".join(sorted(known)) or "nothing"
        raise ForbesError(f"{path}: has no curve for {task}, only for {listed}. Name another file, or none")
    return curves


def _points(steps: Sequence[float], returns: Sequence[float]) -> pd.Series:
    """Return the mean of the returns in each bin of env steps, at the mean of their steps."""
    table = pd.DataFrame({"step": steps, "return": returns}, dtype=float)
    means = table.groupby(table["step"] // _BIN).mean()
    return means.set_index("step")["return"]
