"""Plot the returns of agents against env steps, with published curves for comparison."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from forbes.errors import ForbesError
from forbes.figures.style import BLACK, COLUMN, GREY, draw_range, method_styles, method_title, paper_style
from forbes.runs.folder import RunFolder, read_config, read_metrics

__all__ = ["draw_returns", "return_curve", "returns_against_env_steps"]


def draw_returns(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw the returns of agents on one task without exploration against env steps.

    Runs whose folder names differ only in the number at the end form one curve, named after the folders.

    Raises:
        ForbesError: if a run has no measured returns, or the runs are of several tasks.
    """
    return {"returns": returns_against_env_steps(*_agents(runs))}


def _agents(runs: Sequence[str]) -> tuple[str, dict[str, list[pd.Series]]]:
    """Return the task of the agents, and the curves of their returns, one per seed, by name."""
    curves: dict[str, list[pd.Series]] = {}
    tasks = set()
    for run in runs:
        metrics = read_metrics(run)
        if not {"env_steps", "return/acting"} <= {*metrics}:
            raise ForbesError(f"{run}: metrics.jsonl has no return/acting. Name runs of agents with measured returns")
        tasks.add(_task(RunFolder(run).config))
        name = re.sub(r"-\d+$", "", Path(run).absolute().name)
        measured = metrics[["env_steps", "return/acting"]].dropna()
        curves.setdefault(name, []).append(measured.set_index("env_steps")["return/acting"])
    if len(tasks) > 1:
        raise ForbesError(
            f"--runs: the tasks are {' and '.join(sorted(tasks))}, expected one task. Draw each task separately"
        )
    return tasks.pop(), curves


def _task(path: Path) -> str:
    """Return the task in an agent's configuration."""
    try:
        return str(read_config(path)["data"]["init_args"]["source"]["init_args"]["task"])
    except (KeyError, TypeError) as error:
        raise ForbesError(f"{path}: its data have no task, expected Experience. Name runs of agents") from error


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
        for method, style in method_styles([*published]).items():
            curves = published[method]
            label = f"{method_title(method)}, published, {len(curves)} seeds"
            draw_range(axes, _joined(curves), style, label)
        marker = "." if len(exploring) == 1 else ""
        axes.plot(exploring.index, exploring, color=GREY, lw=0.6, label="exploring", marker=marker)
        axes.plot(acting.index, acting, ".-", color=BLACK, markersize=3, label="acting, without exploration")
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
        styles = method_styles([*agents])
        for name, curves in agents.items():
            label = method_title(name) + (f", {len(curves)} seeds" if len(curves) > 1 else "")
            if (joined := _joined(curves)).empty:
                raise ForbesError(f"{name}: no step was reached by all its {len(curves)} seeds. Train them further")
            draw_range(axes, joined, styles[name], label)
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
