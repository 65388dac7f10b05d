"""Draw the calibration of beliefs: histogram of ranks, their distribution function, and coverage."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from torch import Tensor

from forbes.errors import ForbesError
from forbes.evaluation.calibration.ranks import coverage
from forbes.evaluation.calibration.runs import calibrate_run
from forbes.evaluation.calibration.uniformity import binomial_interval, ecdf_band
from forbes.evaluation.runs import load_runs
from forbes.figures.families import group, require_same_data
from forbes.figures.style import BLACK, GREY, PAGE, Method, paper_style
from forbes.seeding import generator

__all__ = ["RankedBelief", "calibration", "draw_calibration"]

_SEQUENCES, _SAMPLES, _TIME = 1000, 99, 15
"""Defaults of `forbes calibrate`: sequences and samples, and the step that is checked."""

_CONFIDENCE = 0.95
_BINS = 20
_LEVELS = 101


class RankedBelief(NamedTuple):
    """A belief with the ranks of N true values among L of its samples (`forbes.evaluation.calibration.ranks.ranks`)."""

    name: str
    style: Method
    value_ranks: Tensor
    """Ranks of the values, `(N, D)`, drawn as one line per dimension."""
    density_ranks: Tensor | None
    """Ranks of their log-densities, `(N,)`; None for a belief without a density, whose coverage is not drawn."""


def draw_calibration(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw `calibration` of trained models against themselves, as `forbes calibrate` does, one line per run.

    Of data with fewer than 1000 sequences or 15 steps, all are used.

    Raises:
        ForbesError: if a model has no state that could be ranked, or the runs are of different data.
    """
    trained = load_runs(runs)
    require_same_data(trained)
    data = trained[0].data
    sequences, time = min(_SEQUENCES, data.source.size("train")), min(_TIME, data.length)
    beliefs = []
    for family in group(trained):
        for run in family.runs:
            found = calibrate_run(run, sequences, time, _SAMPLES)
            beliefs.append(RankedBelief(family.label, family.style, found.value, found.density))
    return {"calibration": calibration(beliefs, _SAMPLES)}


def calibration(beliefs: Sequence[RankedBelief], samples: int) -> Figure:
    """Draw the histogram of ranks, the deviation of their distribution function, and the coverage of each belief.

    The bands are those of a calibrated belief at 95 %. In the first two panels a band holds for the whole curve, in the
    third for each level separately.

    Args:
        beliefs: beliefs with the same number of ranks.
        samples: number of samples that were ranked, L.
    """
    count = len(beliefs[0].value_ranks)
    for belief in beliefs:
        found = [len(ranks) for ranks in (belief.value_ranks, belief.density_ranks) if ranks is not None]
        if found != [count] * len(found):
            raise ForbesError(
                f"{belief.name}: {' and '.join(map(str, found))} ranks, expected {count} as for {beliefs[0].name}. "
                "Rank the same states under each belief"
            )
    with paper_style():
        figure = Figure((PAGE, 2.3), layout="constrained")
        histogram, difference, covered = figure.subplots(1, 3)
        _draw_histogram(histogram, beliefs, count, samples)
        _draw_difference(difference, beliefs, count, samples)
        _draw_coverage(covered, beliefs, count, samples)
        styles = {belief.name: belief.style for belief in beliefs}  # several runs may have one name
        lines = [Line2D([], [], color=style.colour, ls=style.line, label=name) for name, style in styles.items()]
        band = Patch(color=GREY, alpha=0.3, lw=0, label="calibrated, 95 %")
        figure.legend(handles=[*lines, band], loc="outside upper center", ncols=len(lines) + 1)
    return figure


def _draw_histogram(axes: Axes, beliefs: Sequence[RankedBelief], count: int, samples: int) -> None:
    """Draw the density of ranks, with a simultaneous band for all bins (Bonferroni, as bins are nearly independent)."""
    bins = min(_BINS, samples + 1)
    bin_of = torch.arange(samples + 1) * bins // (samples + 1)  # (L + 1,)
    width = bin_of.bincount() / (samples + 1)  # (bins,), nearly equal
    edges = torch.nn.functional.pad(width.cumsum(0), (1, 0)).tolist()
    low, high = binomial_interval(count, width, 1 - (1 - _CONFIDENCE) / bins)
    axes.stairs((high / width).tolist(), edges, baseline=(low / width).tolist(), fill=True, color=GREY, alpha=0.3, lw=0)
    axes.axhline(1, color=BLACK, lw=0.6)
    for belief in beliefs:
        for ranks in belief.value_ranks.T:
            density = bin_of[ranks].bincount(minlength=bins) / count / width  # (bins,)
            axes.stairs(density.tolist(), edges, color=belief.style.colour, alpha=_alpha(belief), baseline=None)
    axes.set(xlabel="rank of the true value / L", ylabel="density of ranks", xlim=(0, 1))
    axes.set_ylim(bottom=0)


def _draw_difference(axes: Axes, beliefs: Sequence[RankedBelief], count: int, samples: int) -> None:
    """Draw the distribution function of the ranks minus that of uniform ranks."""
    uniform = torch.linspace(0, 1, samples + 2, dtype=torch.float64)  # (L + 2,), P(rank < 0), ..., P(rank < L + 1)
    low, high = ecdf_band(count, samples, _CONFIDENCE, generator(0, "calibration figure", count))
    low, high = (torch.cat((uniform[:1], end, uniform[-1:])) - uniform for end in (low, high))  # (L + 2,)
    axes.fill_between(uniform, low, high, color=GREY, alpha=0.3, lw=0)
    axes.axhline(0, color=BLACK, lw=0.6)
    for belief in beliefs:
        for ranks in belief.value_ranks.T:
            below = torch.nn.functional.pad(ranks.bincount(minlength=samples + 1).double().cumsum(0), (1, 0)) / count
            axes.plot(uniform, below - uniform, color=belief.style.colour, ls=belief.style.line, alpha=_alpha(belief))
    axes.set(xlabel="rank of the true value / L", ylabel="ECDF − uniform", xlim=(0, 1))


def _draw_coverage(axes: Axes, beliefs: Sequence[RankedBelief], count: int, samples: int) -> None:
    """Draw the coverage of the highest-density regions."""
    levels = torch.linspace(0, 1, _LEVELS, dtype=torch.float64)
    low, high = binomial_interval(count, levels, _CONFIDENCE)
    axes.fill_between(levels, low, high, color=GREY, alpha=0.3, lw=0)
    axes.plot([0, 1], [0, 1], color=BLACK, lw=0.6)
    for belief in beliefs:
        if belief.density_ranks is not None:
            inside = coverage(belief.density_ranks, samples, levels)
            axes.plot(levels, inside, color=belief.style.colour, ls=belief.style.line)
    axes.set(xlabel="nominal level of the region", ylabel="true values inside", xlim=(0, 1), ylim=(0, 1))
    axes.set_aspect("equal")


def _alpha(belief: RankedBelief) -> float:
    """Return the opacity of the lines: the more dimensions, the fainter."""
    return max(0.3, 1 / belief.value_ranks.shape[1])
