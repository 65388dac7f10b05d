"""The ELBO of stored episodes against updates (the paper's appendix on the ELBO on DeepMind Control)."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from forbes.errors import ForbesError
from forbes.evaluation.methods import RecordedRun, group_by_method, read_run
from forbes.figures.agents import variant_styles
from forbes.figures.returns import join_seeds
from forbes.figures.style import COLUMN, PAGE, draw_range, paper_style, show_settled
from forbes.runs.folder import read_metrics

__all__ = ["draw_dmc_elbo"]


class BoundCurve(NamedTuple):
    """The bound of a run against updates."""

    name: str
    """Split and name of the bound, e.g. `val/elbo[normal(1),S=1]`."""
    curve: pd.Series


def draw_dmc_elbo(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw the training bound against updates, mean and range over seeds, one panel per store of episodes or task.

    World models are drawn with the bound on the validation split. Agents have no such split, and are drawn with the
    bound of their training batches.

    Raises:
        ForbesError: if a run has no bound yet or is not of episodes, or two runs of a panel have different bounds.
    """
    recorded = [read_run(path) for path in runs]
    for run in recorded:
        if run.source not in ("Replay", "Experience"):
            raise ForbesError(
                f"{run.path}: its data are {run.source}, expected Replay or Experience. Draw it by: forbes figures elbo"
            )
    grouped = group_by_method(recorded)
    columns = min(3, len(grouped))
    rows = math.ceil(len(grouped) / columns)
    with paper_style():
        figure = Figure((PAGE if columns > 1 else COLUMN, 2.0 * rows + 0.4), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).flat
        for axes, (task, of_task) in zip(panels, grouped.items(), strict=False):
            found = {title: [_bound(run) for run in of_one] for title, of_one in of_task.items()}
            name = _common_name(found, of_task)
            styles = variant_styles({title: of_one[0].method for title, of_one in of_task.items()})
            for title, bounds in found.items():
                label = title if len(bounds) == 1 else f"{title}, {len(bounds)} seeds"
                draw_range(axes, join_seeds([bound.curve for bound in bounds]), styles[title], label)
            show_settled(axes, [bound.curve for bounds in found.values() for bound in bounds])
            split, _, rest = name.partition("/")
            score = rest.partition("[")[0].replace("elbo", "ELBO")
            axes.set(title=task, xlabel="updates", ylabel=f"{_SPLITS[split]} {score}\nnats per sequence")
            axes.legend(loc="lower right")
        for axes in panels[len(grouped) :]:
            axes.remove()
    return {"dmc-elbo": figure}


_SPLITS = {"val": "validation", "train": "training"}


def _bound(run: RecordedRun) -> BoundCurve:
    """Return the bound on the validation split if it was logged, else that of the training batches."""
    metrics = read_metrics(run.path)
    names = [name for split in _SPLITS for name in metrics if re.match(rf"{split}/(elbo|fivo|log_p)\[", str(name))]
    if not names:
        raise ForbesError(f"{run.path}: metrics.jsonl has no bound. Train the run further")
    return BoundCurve(str(names[0]), metrics[names[0]].dropna())


def _common_name(found: dict[str, list[BoundCurve]], runs: dict[str, list[RecordedRun]]) -> str:
    """Return the name of the bound of all runs of a panel."""
    names = {
        run.path: bound.name for title, bounds in found.items() for run, bound in zip(runs[title], bounds, strict=True)
    }
    first, expected = next(iter(names.items()))
    for path, name in names.items():
        if name != expected:
            raise ForbesError(f"{path}: its bound is {name}, that of {first} is {expected}, expected the same")
    return expected
