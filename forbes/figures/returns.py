"""What an agent earns while it learns, against the frames it has seen, beside curves that others have published."""

import json
from collections.abc import Mapping, Sequence
from itertools import cycle

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from forbes.errors import ForbesError
from forbes.figures.style import COLUMN, GREY, ORANGE, PALETTE, draw_range, paper_style

__all__ = ["published_curves", "return_curve"]


def return_curve(metrics: pd.DataFrame, task: str, published: Mapping[str, Sequence[pd.Series]]) -> Figure:
    """Draw the return without exploration, and that of the collected episodes, against env steps.

    Args:
        metrics: of the run, as `read_metrics` gives them.
        task: the title.
        published: see `published_curves`; mean and range over seeds, as far as the run has come.
    """
    table = metrics.reindex(columns=["env_steps", "return/acting", "return/exploring"]).set_index("env_steps")
    acting, exploring = (table[name].dropna() for name in table)
    with paper_style():
        figure = Figure((COLUMN, 2.3), layout="constrained")
        axes = figure.subplots()
        for (method, curves), colour in zip(published.items(), cycle((ORANGE, *PALETTE[2:])), strict=False):
            # Seeds that were measured at different steps meet at all of them.
            seeds = pd.concat(curves, axis=1).interpolate("index", limit_area="inside").dropna()
            draw_range(axes, seeds, colour, f"{method}, published, {len(curves)} seeds")
        axes.plot(exploring.index, exploring, color=GREY, lw=0.6, label="exploring")
        axes.plot(acting.index, acting, ".-", color=PALETTE[0], markersize=3, label="acting, without exploration")
        axes.set(xlabel="env steps (frames)", ylabel="return of an episode", title=task)
        axes.set_xlim(0, 1.02 * table.index.max())
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k, 1M
        axes.locator_params("x", nbins=6)
        axes.legend(loc="best")
    return figure


def published_curves(path: str, task: str) -> dict[str, list[pd.Series]]:
    """Read the curves of a task: by method, one for each seed, returns against env steps.

    Args:
        path: a JSON list of `{"task": …, "method": …, "seed": …, "xs": [env steps], "ys": [returns]}`, as the Dreamer
            authors publish it; their names of tasks begin with `dmc_`.
        task: ours, `cartpole_swingup`.

    Raises:
        ForbesError: where the file cannot be read so, or does not have the task.
    """
    names = {task, f"dmc_{task}", f"dmc_{task.removeprefix('ball_in_')}"}  # Dreamer's name of it is cup_catch
    curves: dict[str, list[pd.Series]] = {}
    known = set()
    try:
        with open(path) as file:
            for one in json.load(file):
                known.add(one["task"])
                if one["task"] in names:
                    curve = pd.Series(one["ys"], index=one["xs"], dtype=float)
                    curves.setdefault(one["method"], []).append(curve)
    except OSError as error:
        raise ForbesError(f"{path}: no such file of curves that can be read. Name another, or none") from error
    except (ValueError, KeyError, TypeError) as error:
        expected = "a JSON list of task, method, seed, xs and ys"
        raise ForbesError(f"{path}: not a file of curves, expected {expected}. Name another, or none") from error
    if not curves:
        listed = ", ".join(sorted(known)) or "nothing"
        raise ForbesError(f"{path}: has no curve of {task}, but of {listed}. Name another file, or none")
    return curves
