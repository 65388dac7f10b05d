"""Plot the returns of agents against env steps, with published curves for comparison."""

from collections.abc import Mapping, Sequence
from itertools import cycle

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from forbes.errors import ForbesError
from forbes.figures.style import COLUMN, GREY, ORANGE, PALETTE, draw_range, paper_style

__all__ = ["return_curve", "returns_against_env_steps"]


def return_curve(metrics: pd.DataFrame, task: str, published: Mapping[str, Sequence[pd.Series]]) -> Figure:
    """Draw the return without exploration, and that of the collected episodes, against env steps.

    Args:
        metrics: metrics of the run, from `read_metrics`.
        task: name of the task, used as title.
        published: result of `published_curves`, drawn as mean and range over seeds up to the run's last step.
    """
    table = metrics.reindex(columns=["env_steps", "return/acting", "return/exploring"]).set_index("env_steps")
    acting, exploring = (table[name].dropna() for name in table)
    with paper_style():
        figure = Figure((COLUMN, 2.3), layout="constrained")
        axes = figure.subplots()
        for (method, curves), colour in zip(published.items(), cycle((ORANGE, *PALETTE[2:])), strict=False):
            draw_range(axes, _joined(curves), colour, f"{method}, published, {len(curves)} seeds")
        marker = "." if len(exploring) == 1 else ""
        axes.plot(exploring.index, exploring, color=GREY, lw=0.6, label="exploring", marker=marker)
        axes.plot(acting.index, acting, ".-", color=PALETTE[0], markersize=3, label="acting, without exploration")
        _label(axes, task, table.index.max())
    return figure


def returns_against_env_steps(task: str, agents: Mapping[str, Sequence[pd.Series]]) -> Figure:
    """Draw the returns of agents without exploration: mean and range over seeds, at the steps that all seeds reached.

    Args:
        task: name of the task, used as title.
        agents: curves of returns against env steps by agent, one per seed.

    Raises:
        ForbesError: if the curves of an agent have no step in common.
    """
    with paper_style():
        figure = Figure((COLUMN, 2.6), layout="constrained")
        axes = figure.subplots()
        for (name, curves), colour in zip(agents.items(), cycle(PALETTE), strict=False):
            label = name if len(curves) == 1 else f"{name}, {len(curves)} seeds"
            if (joined := _joined(curves)).empty:
                raise ForbesError(f"{name}: no step was reached by all its {len(curves)} seeds. Train them further")
            draw_range(axes, joined, colour, label)
        _label(axes, task, max(curve.index.max() for curves in agents.values() for curve in curves))
    return figure


def _joined(curves: Sequence[pd.Series]) -> pd.DataFrame:
    """Interpolate the curves of all seeds to common steps."""
    return pd.concat(curves, axis=1).sort_index().interpolate("index", limit_area="inside").dropna()


def _label(axes: Axes, task: str, end: float) -> None:
    axes.set(xlabel="env steps (frames)", ylabel="return per episode", title=task)
    axes.set_xlim(0, 1.02 * end)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k, 1M
    axes.locator_params("x", nbins=6)
    axes.legend(loc="best")
