"""Plot the returns of one agent during its training, with published curves for comparison."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from forbes.figures.style import BLACK, COLUMN, GREY, draw_range, method_styles, method_title, paper_style, task_title

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["join_seeds", "return_curve"]


def return_curve(metrics: "pd.DataFrame", task: str, published: "Mapping[str, Sequence[pd.Series]]") -> Figure:
    """Draw the return without exploration, and that of the collected episodes, against env steps.

    Args:
        metrics: metrics of the run, from `read_metrics`.
        task: name of the task, used as title.
        published: result of `published_curves`, drawn as mean and range over seeds up to the run's last step.
    """
    table = metrics.reindex(columns=["env_steps", "return/acting", "return/exploring"]).set_index("env_steps")
    acting, exploring = (table[name].dropna() for name in table)
    with paper_style():
        figure = Figure((COLUMN, 2.7), layout="constrained")
        axes = figure.subplots()
        for method, style in method_styles([*published]).items():
            curves = published[method]
            label = f"{method_title(method)}, published, {len(curves)} seeds"
            draw_range(axes, join_seeds(curves), style, label)
        marker = "." if len(exploring) == 1 else ""
        axes.plot(exploring.index, exploring, color=GREY, lw=0.6, label="exploring", marker=marker)
        axes.plot(acting.index, acting, ".-", color=BLACK, markersize=3, label="acting, without exploration")
        _label(axes, task, table.index.max())
        figure.legend(loc="outside upper center")
    return figure


def join_seeds(curves: "Sequence[pd.Series]") -> "pd.DataFrame":
    """Interpolate the curves of all seeds to common steps, one column each."""
    import pandas as pd

    return pd.concat(curves, axis=1).sort_index().interpolate("index", limit_area="inside").dropna()


def _label(axes: Axes, task: str, end: float) -> None:
    axes.set(xlabel="env steps (frames)", ylabel="return per episode", title=task_title(task))
    axes.set_xlim(0, 1.02 * end)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k, 1M
    axes.locator_params("x", nbins=6)
