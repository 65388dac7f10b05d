"""The paper's figures of agents: returns against env steps, one panel per task.

Figure 6 and its extension to a million steps show agents next to published results; Figure 7 and the appendix vary the
number of imagined trajectories N and of layers.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from forbes.envs.dm_control import DOMAINS
from forbes.errors import ForbesError
from forbes.evaluation.methods import LAYERS, TRAJECTORIES, RecordedRun, group_by_method, read_run, returns_of
from forbes.evaluation.published import published_curves, published_returns
from forbes.evaluation.returns import Summary, summarise
from forbes.evaluation.runs import require_distinct
from forbes.figures.returns import join_seeds
from forbes.figures.style import (
    BLACK,
    COLUMN,
    GREY,
    PAGE,
    Method,
    draw_range,
    method_styles,
    method_title,
    paper_style,
    task_title,
)

__all__ = ["PAPER_TASKS", "draw_layers", "draw_returns", "draw_returns_1m", "draw_trajectories", "draw_trajectories_n"]
__all__ += ["summarise_returns", "variant_styles"]

PAPER_TASKS = ("cartpole_swingup", "finger_spin", "cheetah_run", "walker_walk", "walker_run", "hopper_stand")
"""Tasks of Figure 6, in its order."""
_PAPER_N = 4
_LIMIT = 500_000  # env steps of the paper's figures, but for one
_MOST = 1000  # return per episode in DeepMind Control
_LEVELS = {"A3C": (0, (1, 1.5)), "D4PG": (0, (6, 2)), "PlaNet": (0, (6, 2, 1, 2))}
"""Published methods that are drawn as a level, with their lines."""


class AgentCurves(NamedTuple):
    """The agents of one configuration on one task."""

    method: str
    curves: list[pd.Series]
    """Returns without exploration against env steps, one curve per seed."""


def draw_returns(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw Figure 6, returns up to 500,000 env steps, and print their summary.

    If the runs have several of the paper's tasks, there is a panel for each of the six. A panel without a run says so.
    The returns of tasks that are not of DeepMind Control are drawn to their end.

    Raises:
        ForbesError: if a run has no measured returns, or the seeds of a method have no step in common.
    """
    return {"returns": _returns(runs, _LIMIT)}


def draw_returns_1m(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw the same as `draw_returns` up to a million env steps."""
    return {"returns-1m": _returns(runs, 2 * _LIMIT)}


def _returns(runs: Sequence[str], limit: int) -> Figure:
    agents = _read([read_run(path) for path in runs], limit)
    for title, summary in _summaries(agents).items():
        print(title, *summary.lines(), sep="\n")
    if sum(task in PAPER_TASKS for task in agents) > 1:
        agents = {task: agents.get(task, {}) for task in (*PAPER_TASKS, *agents)}
    return _draw(agents, published=True)


def draw_trajectories(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw Figure 7: Dreamer with different numbers of imagined trajectories, N, and FORBES with N = 4.

    Other agents are left out, as in the figures below, and tasks with one agent only if another task has more.
    """
    recorded = _with_fewest_layers(runs)
    chosen = [run for run in recorded if run.method == "Dreamer" or _is_papers(run)]
    return {"trajectories": _ablation(chosen, "Dreamer, or FORBES with N = 4", [TRAJECTORIES])}


def draw_trajectories_n(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw FORBES with different numbers of imagined trajectories, N."""
    chosen = [run for run in _with_fewest_layers(runs) if run.method == "FORBES"]
    return {"trajectories-n": _ablation(chosen, "FORBES", [TRAJECTORIES])}


def draw_layers(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw Dreamer with N = 1 and different numbers of layers, and FORBES with N = 4."""
    recorded = [read_run(path) for path in runs]
    one = [run for run in recorded if run.method == "Dreamer" and run.settings.get(TRAJECTORIES) == 1]
    chosen = one + [run for run in recorded if _is_papers(run)]
    return {"layers": _ablation(chosen, "Dreamer with N = 1, or FORBES with N = 4")}


def _ablation(chosen: Sequence[RecordedRun], expected: str, always: Collection[str] = ()) -> Figure:
    if not chosen:
        raise ForbesError(f"--runs: none is an agent of {expected}, which this figure compares. Name some")
    agents = _read(chosen, _LIMIT, always)
    compared = {task: of_task for task, of_task in agents.items() if len(of_task) > 1}
    return _draw(compared or agents)


def _is_papers(run: RecordedRun) -> bool:
    """Return whether a run is FORBES with the paper's number of trajectories."""
    return run.method == "FORBES" and run.settings.get(TRAJECTORIES) == _PAPER_N


def _with_fewest_layers(runs: Sequence[str]) -> list[RecordedRun]:
    """Return the runs without those of the ablation of layers: of each method those with the fewest on a task."""
    recorded = [read_run(path) for path in runs]
    layers: dict[tuple[str, str], list[int]] = {}
    for run in recorded:
        layers.setdefault((run.task, run.method), []).append(run.settings.get(LAYERS, 0))
    return [run for run in recorded if run.settings.get(LAYERS, 0) == min(layers[run.task, run.method])]


def _read(runs: Sequence[RecordedRun], limit: int, always: Collection[str] = ()) -> dict[str, dict[str, AgentCurves]]:
    """Return the agents by task and title, on DeepMind Control up to a number of env steps."""
    agents: dict[str, dict[str, AgentCurves]] = {}
    for task, of_task in group_by_method(runs, always).items():
        cut = slice(limit) if _is_control(task) else slice(None)
        for title, of_one in of_task.items():
            curves = [returns_of(run).loc[cut] for run in of_one]
            if join_seeds(curves).empty:
                upto = f" up to {limit:,}" if _is_control(task) else ""
                raise ForbesError(
                    f"{title} on {task}: no step{upto} was reached by all its {len(curves)} seeds. Train them further"
                )
            agents.setdefault(task, {})[title] = AgentCurves(of_one[0].method, curves)
    return agents


def _is_control(task: str) -> bool:
    """Return whether a task is one of DeepMind Control, whose returns are at most 1,000."""
    return task.startswith(tuple(f"{domain}_" for domain in DOMAINS))


def summarise_returns(runs: Sequence[str], limit: int = _LIMIT) -> dict[str, Summary]:
    """Summarise the returns of runs at the last step, up to `limit`, that all agents of a task have reached.

    The tasks of DeepMind Control, whose returns share a scale, are summarised together, each other task by itself. A
    task that not all methods have is left out. The key of each summary is its title.

    Raises:
        ForbesError: if a run is named twice or has no measured returns, or the seeds of a method have no common step.
    """
    require_distinct(runs)
    return _summaries(_read([read_run(path) for path in runs], limit))


def _summaries(agents: Mapping[str, Mapping[str, AgentCurves]]) -> dict[str, Summary]:
    scores: dict[str, dict[str, dict[str, list[float]]]] = {}
    last = {task: _common_end(of_task) for task, of_task in agents.items() if of_task}
    for task, step in last.items():
        scale = "DeepMind Control" if _is_control(task) else task
        for title, one in agents[task].items():
            values = [float(np.interp(step, curve.index, curve)) for curve in one.curves]
            scores.setdefault(scale, {}).setdefault(title, {})[task] = values
    found = {}
    for methods in scores.values():
        if summary := summarise(methods):
            where = ", ".join(f"{task} at {last[task]:,.0f}" for task in summary.tasks)
            found[f"interquartile mean of the returns, with 95 % bootstrap intervals ({where} env steps)"] = summary
    return found


def _common_end(of_task: Mapping[str, AgentCurves]) -> float:
    """Return the last step that all agents of a task have reached."""
    return float(min(curve.index.max() for one in of_task.values() for curve in one.curves))


def _draw(agents: Mapping[str, Mapping[str, AgentCurves]], published: bool = False) -> Figure:
    """Draw a panel per task: mean and range over seeds of each agent."""
    ends = _ends(agents)
    styles = variant_styles({title: one.method for of_task in agents.values() for title, one in of_task.items()})
    columns = min(3, len(agents))
    rows = math.ceil(len(agents) / columns)
    with paper_style():
        width = PAGE if columns > 1 else COLUMN
        figure = Figure((width, (1.7 if columns > 1 else 2.2) * rows + 0.5), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).flat
        for axes, (task, of_task) in zip(panels, agents.items(), strict=False):
            if published:
                _draw_published(axes, task, ends[task])
            for title, one in of_task.items():
                draw_range(axes, join_seeds(one.curves), styles[title], _label(title, agents))
            _label_panel(axes, task, ends[task], empty=not of_task)
        for axes in panels[len(agents) :]:
            axes.remove()
        figure.supylabel("return per episode", fontsize=8)
        figure.supxlabel("env steps (frames)", fontsize=8)
        _draw_legend(figure, [_label(title, agents) for title in styles], columns)
    return figure


def _ends(agents: Mapping[str, Mapping[str, AgentCurves]]) -> dict[str, float]:
    """Return the last step of each panel: the last of any agent, on all tasks of DeepMind Control the same."""
    last = {
        task: max((float(curve.index.max()) for one in of_task.values() for curve in one.curves), default=0.0)
        for task, of_task in agents.items()
    }
    of_control = max((end for task, end in last.items() if _is_control(task)), default=0.0)
    return {task: of_control if _is_control(task) else end for task, end in last.items()}


def _draw_legend(figure: Figure, first: Sequence[str], columns: int) -> None:
    """Draw one legend for all panels, agents first: above them, or beside a single panel of many lines."""
    lines = {str(line.get_label()): line for axes in figure.axes for line in axes.get_lines()[::-1]}
    others = [name for name in lines if name not in first and not name.startswith("_")]
    shown = [*first, *others]
    handles = [lines[name] for name in shown]
    if columns == 1 and len(shown) > 4:
        figure.set_size_inches(PAGE, figure.get_figheight())
        figure.legend(handles, shown, loc="outside right upper")
    else:
        figure.legend(handles, shown, loc="outside upper center", ncols=3 if columns > 1 else 2)


def _label(title: str, agents: Mapping[str, Mapping[str, AgentCurves]]) -> str:
    """Return a title with its number of seeds, or the lowest and highest number over tasks."""
    seeds = [len(of_task[title].curves) for of_task in agents.values() if title in of_task]
    if max(seeds) == 1:
        return title
    return f"{title}, {max(seeds) if min(seeds) == max(seeds) else f'{min(seeds)}–{max(seeds)}'} seeds"


def _draw_published(axes: Axes, task: str, end: float) -> None:
    """Draw what is published: levels and curves; of Dreamer means with their spread if its curves are not fetched."""
    table = published_returns(task)
    for row in table[table["method"].isin(_LEVELS)].itertuples():
        label = f"{row.method}, published, {EngFormatter(sep='')(row.env_steps)} steps"
        axes.axhline(row.value, color=GREY, ls=_LEVELS[row.method], lw=0.9, label=label)
    published = published_curves(None, task)
    for method, colour in (("dreamer", GREY), ("dreamerv3", BLACK)):
        if curves := published.get(method):
            style, label = Method(colour), f"{method_title(method)}, published"
            draw_range(axes, join_seeds(curves).loc[: 1.02 * end], style, f"{label}, {len(curves)} seeds")
    if "dreamer" not in published:
        points = table[(table["method"] == "Dreamer") & (table["env_steps"] <= 1.02 * end)]
        steps, means, spreads = (points[name].to_numpy() for name in ("env_steps", "value", "spread"))
        if len(points):
            axes.errorbar(steps, means, spreads, fmt="D", color=GREY, markersize=3, capsize=2, clip_on=False)
            axes.plot([], [], "D", color=GREY, markersize=3, label="Dreamer, published, mean ± sd")


def _label_panel(axes: Axes, task: str, end: float, empty: bool) -> None:
    axes.set_title(task_title(task))
    axes.set_xlim(0, 1.02 * end)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k, 1M
    axes.locator_params("x", nbins=5)
    if _is_control(task):
        axes.set_ylim(0, 1.02 * _MOST)
    if empty:
        above = {"facecolor": "white", "edgecolor": "none", "pad": 2}
        axes.text(0.5, 0.5, "no run", transform=axes.transAxes, ha="center", va="center", color=BLACK, bbox=above)


def variant_styles(methods: Mapping[str, str]) -> dict[str, Method]:
    """Return a style for each title, given its method: the method's own for the first, then paler and dashed ones."""
    own = method_styles(list(dict.fromkeys(methods.values())))
    styles = {}
    for number, (title, method) in enumerate(methods.items()):
        before = [other for other in list(methods.values())[:number] if other == method]
        styles[title] = _variant(own[method], len(before))
    return styles


def _variant(style: Method, number: int) -> Method:
    """Return the n-th variant of a style: its colour mixed with white, another line and marker."""
    if number == 0:
        return style
    share = min(0.3 * number, 0.6)
    red, green, blue = (share + (1 - share) * part for part in to_rgb(style.colour))
    return Method(to_hex((red, green, blue)), [(0, (3, 1)), (0, (1, 1))][(number - 1) % 2], "s^v"[(number - 1) % 3])
