"""Recorded scores of families: the ELBO and its parts at each step, and the prequential log-likelihood."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forbes.errors import ForbesError
from forbes.evaluation.metrics import score_of
from forbes.evaluation.runs import TrainedRun, recorded_runs
from forbes.figures.families import RunFamily, group, recorded_entries, require_same_data
from forbes.figures.style import BLACK, PAGE, draw_range, draw_references, paper_style

__all__ = ["draw_per_step", "draw_prequential"]

_PARTS = {
    "elbo": "ELBO",
    "reconstruction": "log-likelihood, $\\log p(o_t | h_t, s_t)$",
    "kl": "KL, posterior from prior",
}


def draw_per_step(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw the recorded ELBO and its parts at each step, mean and range over the runs of each family.

    Each step's value is the mean over the sequences that have it.

    Raises:
        ForbesError: if the runs are of different data, or a run has no recorded ELBO.
    """
    families = _families(runs)
    with paper_style():
        figure = Figure((PAGE, 2.2), layout="constrained")
        panels = figure.subplots(1, len(_PARTS))
        for axes, (score, title) in zip(panels, _PARTS.items(), strict=True):
            name = _common(families, score)
            _draw_steps(axes, families, name)
            axes.set(title=title, ylabel="nats per step" if axes is panels[0] else "")
        _draw_legend(figure, panels[0])
        figure.supxlabel(f"step t; {_common(families, 'elbo')}", fontsize=7)
    return {"per-step": figure}


def draw_prequential(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw the recorded prequential log-likelihood: its difference to the first family at each step, and its sum.

    At each step it is the mean and range over the runs of each family, minus the mean of the first family. The sum is a
    dot per run, with the standard error over sequences. Black is the process's own log-likelihood, if it is recorded.
    Dotted lines are models without a belief.

    Raises:
        ForbesError: if the runs are of different data, or a run has no recorded prequential score.
    """
    families = _families(runs)
    name = _common(families, "pll")
    first = _entries(families[0].runs[0])
    exact = first.get(f"{name.partition('/')[0]}/log_p[exact]")
    with paper_style():
        figure = Figure((PAGE, 2.2), layout="constrained")
        steps, totals = figure.subplots(1, 2)
        baseline = _curves(families[0], name).mean(axis=1)
        _draw_steps(steps, families, name, baseline)
        if exact:
            steps.plot(baseline.index, exact["curve"] - baseline, color=BLACK, lw=0.8, label="exact log p")
        title = rf"$\log p(o_t | o_{{1:t-1}})$ minus {families[0].name}'s"
        steps.set(title=title, xlabel="step t", ylabel="nats per step")
        _draw_totals(totals, families, name, exact)
        references = {name: each["mean"] for name, each in first[name].get("references", {}).items()}
        if draw_references(totals, references, "x"):
            totals.set_ylim(bottom=4 / 3 * len(families) - 0.5)  # the lowest quarter is for their label
        totals.set(title=r"$\log p(o_{1:T})$, its sum", xlabel="nats per sequence, higher is better")
        totals.locator_params("x", nbins=5)
        _draw_legend(figure, steps)
        figure.supxlabel(name, fontsize=7)
    return {"prequential": figure}


def _families(runs: Sequence[str]) -> list[RunFamily]:
    trained = recorded_runs(runs)
    require_same_data(trained)
    return group(trained)


def _entries(run: TrainedRun) -> dict[str, dict[str, Any]]:
    """Return the recorded entries of this checkpoint that have a curve over steps."""
    fields = {"mean", "standard_error", "curve", "data"}
    return {name: entry for name, entry in recorded_entries(run).items() if fields <= entry.keys()}


def _common(families: Sequence[RunFamily], score: str) -> str:
    """Return the metric of a score that all runs have recorded for the same sequences, that of most sequences first."""
    runs = [run for family in families for run in family.runs]
    first, *others = [_entries(run) for run in runs]
    names = [name for name in first if score_of(name) == score]
    for name in sorted(names, key=lambda name: first[name]["sequences"], reverse=True):
        entries = [found[name] for found in (first, *others) if name in found]
        if len({(one["data"]["sha256"], len(one["curve"])) for one in entries}) == 1 and len(entries) == len(runs):
            return name
    lacking = next((run for run in runs if not any(score_of(name) == score for name in _entries(run))), runs[0])
    raise ForbesError(
        f"{lacking.path}: evaluation.json has no {score} of this checkpoint that all runs have. Run: forbes evaluate "
        + " ".join(run.path for run in runs)
    )


def _curves(family: RunFamily, name: str) -> pd.DataFrame:
    """Return a metric at each step, counted from 1, one column per run."""
    curves = np.transpose([_entries(run)[name]["curve"] for run in family.runs])  # (T, runs)
    return pd.DataFrame(curves, index=range(1, len(curves) + 1))


def _draw_steps(axes: Axes, families: Sequence[RunFamily], name: str, baseline: pd.Series | float = 0.0) -> None:
    for family in families:
        draw_range(axes, _curves(family, name).sub(baseline, axis=0), family.style, family.label)


def _draw_totals(axes: Axes, families: Sequence[RunFamily], name: str, exact: dict[str, Any] | None) -> None:
    """Draw a line of dots per family."""
    for y, family in enumerate(families):
        entries = [_entries(run)[name] for run in family.runs]
        heights = y + 0.5 * (np.arange(1, len(entries) + 1) / (len(entries) + 1) - 0.5)
        means, widths = ([entry[field] for entry in entries] for field in ("mean", "standard_error"))
        colour = family.style.colour
        axes.errorbar(means, heights, xerr=widths, fmt=family.style.marker, ms=4, color=colour, elinewidth=0.8)
    if exact:
        axes.axvline(exact["mean"], color=BLACK, lw=0.8)
    axes.set_yticks(range(len(families)), [family.name for family in families])
    axes.set_ylim(len(families) - 0.5, -0.5)


def _draw_legend(figure: Figure, axes: Axes) -> None:
    lines, labels = axes.get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside upper center", ncols=min(4, len(lines)), handlelength=3)
