"""Compare families in three figures: scores, scores per step, and differences by score."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forbes.evaluation.comparison import Comparison
from forbes.evaluation.metrics import SCORES, score_of
from forbes.figures.style import COLUMN, GREY, PAGE, Method, draw_references, method_styles, method_title, paper_style

__all__ = ["draw_differences", "draw_per_step", "draw_scores"]

_PER_STEP = ("elbo", "pll", "open_loop_marginal", "degradation", "ess")
"""Scores that are meaningful at a single step."""
_FAR = 5  # distance of an outlier, in multiples of the range of the other families


def draw_scores(comparison: Comparison) -> Figure:
    """Draw each score in a panel: one dot per seed with its standard error, and a bar at the mean over seeds.

    The line of a family without the score stays empty. A family far below the others is not drawn to scale: its mean is
    printed at the left edge. A dashed line is the exact log-likelihood, if known; dotted lines are models without a
    belief.
    """
    table = comparison.scores
    exact = table[[score_of(metric) == "log_p" for metric in table["metric"]]].groupby("metric")["mean"].mean().dropna()
    metrics = [metric for metric in table["metric"].unique() if score_of(metric) in SCORES]
    families = list(table["family"].unique())
    columns = min(3, len(metrics))
    rows = math.ceil(len(metrics) / columns)
    with paper_style():
        figure = Figure((PAGE, rows * (1.1 + 0.22 * len(families))), layout="constrained")
        panels = figure.subplots(rows, columns, sharey=True, squeeze=False).flat
        dotted = dashed = False
        for axes, metric in zip(panels, metrics, strict=False):
            _draw_score(axes, table[table["metric"] == metric], families)
            known = exact.get(f"{metric.partition('/')[0]}/log_p[exact]")  # of the same sequences
            if score_of(metric) != "open_loop" and known is not None:
                axes.axvline(known, color=GREY, ls="--", lw=0.8)
                dashed = True
            axes.set_title(_in_lines(metric))
            axes.margins(x=0.15)
            dotted |= draw_references(axes, comparison.references.get(metric, {}), along="x")
            axes.locator_params(axis="x", nbins=4)  # more labels would touch
        for axes in panels[len(metrics) :]:
            axes.remove()
        panels[0].set_yticks(range(len(families)), [method_title(name) for name in families])
        rows_and_label = len(families) * (4 / 3 if dotted else 1)  # the lowest quarter is for the references' label
        panels[0].set_ylim(rows_and_label - 0.5, -0.5)
        ceiling = ", dashed: the exact log p, which no bound exceeds" if dashed else ""
        names = list(next(iter(comparison.references.values()), {}))
        below = f", dotted: models without a belief, {names[0]} to {names[-1]}" if dotted else ""
        figure.supxlabel(f"nats per sequence, higher is better{ceiling}{below}", fontsize=8)
    return figure


def _draw_score(axes: Axes, of_metric: pd.DataFrame, families: Sequence[str]) -> None:
    near = _near(of_metric.groupby("family", sort=False)["mean"].mean().dropna())
    for y, (name, style) in enumerate(method_styles(families).items()):
        seeds = of_metric[of_metric["family"] == name]
        mean = seeds["mean"].mean()
        if name in near:
            heights = y + 0.3 * (np.arange(1, len(seeds) + 1) / (len(seeds) + 1) - 0.5)
            widths, colour = seeds["standard_error"], style.colour
            axes.errorbar(seeds["mean"], heights, xerr=widths, fmt=style.marker, ms=3, color=colour, elinewidth=0.8)
            axes.plot([mean] * 2, [y - 0.35, y + 0.35], color=style.colour)
        elif not np.isnan(mean):
            at_edge = axes.get_yaxis_transform()
            axes.text(
                0.02,
                y,
                f"← {mean:.1f}".replace("-", "−"),
                transform=at_edge,
                va="center",
                color=style.colour,
                fontsize=7,
            )


def _near(means: pd.Series) -> list[str]:
    """Return the families to draw to scale: the lowest is dropped while it is far below the others, at least 3."""
    ordered = means.sort_values(ascending=False)
    while len(ordered) > 3 and ordered.iloc[0] - ordered.iloc[-1] > _FAR * (ordered.iloc[0] - ordered.iloc[-2]):
        ordered = ordered.iloc[:-1]
    return list(ordered.index)


def draw_per_step(comparison: Comparison) -> Figure | None:
    """Draw the mean at each step over sequences and seeds, one panel per score; None if no score has steps."""
    metrics = [metric for metric in comparison.curves if score_of(metric) in _PER_STEP]
    if not metrics:
        return None
    columns = min(3, len(metrics))
    rows = math.ceil(len(metrics) / columns)
    styles = method_styles(list(comparison.scores["family"].unique()))
    with paper_style():
        figure = Figure((PAGE if columns > 1 else COLUMN, 2.4 * rows + 0.2), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).flat
        for axes, metric in zip(panels, metrics, strict=False):
            _draw_steps(axes, comparison.curves[metric], metric, styles)
        for axes in panels[len(metrics) :]:
            axes.remove()
        lines = {line.get_label(): line for axes in figure.axes for line in axes.lines}  # not all panels have all
        named = {title: lines[title] for title in map(method_title, styles) if title in lines}
        figure.legend(named.values(), named.keys(), loc="outside upper center", ncols=4 if columns > 1 else 2)
    return figure


def _draw_steps(axes: Axes, curves: dict[str, list[float]], metric: str, styles: Mapping[str, Method]) -> None:
    for name, curve in curves.items():
        steps = np.arange(1, len(curve) + 1)
        shown = np.cumsum(np.abs(curve)) > 0  # the open-loop score begins after its context
        style = styles[name]
        axes.plot(steps[shown], np.asarray(curve)[shown], color=style.colour, ls=style.line, label=method_title(name))
    axes.set_title(_in_lines(metric))
    axes.set_xlabel("step")
    axes.set_ylabel("fraction of K" if score_of(metric) == "ess" else "nats per step")


def draw_differences(comparison: Comparison, first: str) -> Figure:
    """Draw the mean difference to the first family as a table of families and scores, coloured within each column.

    A cell is n/a if one of the two families does not have the score.
    """
    table = comparison.differences.groupby(["family", "metric"], sort=False)["mean"].mean().unstack(sort=False)
    values = table.to_numpy()  # (families, scores)
    with paper_style():
        figure = Figure((PAGE, 0.9 + 0.3 * len(table)), layout="constrained")
        axes = figure.subplots()
        largest = np.nanmax(np.abs(values), 0)
        axes.imshow(values / np.where(largest > 0, largest, 1), cmap="PuOr", vmin=-3, vmax=3, aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            axes.text(column, row, "n/a" if np.isnan(value) else f"{value:+.2f}", ha="center", va="center")
        axes.set_xticks(range(len(table.columns)), [_in_lines(metric) for metric in table.columns])
        axes.set_yticks(range(len(table)), [method_title(name) for name in table.index])
        axes.set_title(f"difference to {method_title(first)} in nats per sequence, paired, mean over seeds")
        axes.grid(visible=False)
    return figure


def _in_lines(metric: str) -> str:
    """Break a name such as `test[:1000]/pll[bernoulli,K=128]` into lines for score, split and tag."""
    split, _, rest = metric.partition("/")
    score, _, tag = rest.partition("[")
    return f"{score}\n{split}\n[{tag}"
