"""Calibration of beliefs in one picture: ranks as a histogram, their distribution function, and coverage."""

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
from forbes.evaluation.calibration.uniformity import binomial_interval, ecdf_band
from forbes.figures.style import BLACK, GREY, PAGE, paper_style
from forbes.seeding import generator

__all__ = ["RankedBelief", "calibration"]

_CONFIDENCE = 0.95
_BINS = 20
_LEVELS = 101


class RankedBelief(NamedTuple):
    """A belief with the ranks of N true values among L of its samples (`forbes.evaluation.calibration.ranks.ranks`)."""

    name: str
    colour: str
    value_ranks: Tensor
    """Of the values, `(N, D)`: a line for each dimension."""
    density_ranks: Tensor
    """Of their log-densities, `(N,)`."""


def calibration(beliefs: Sequence[RankedBelief], samples: int) -> Figure:
    """Draw the ranks' histogram, what their distribution function is off by, and the coverage of each belief.

    The bands are those of a calibrated belief: in 95 of 100 pictures all of the histogram lies in its band, and so does
    all of the second panel; the third's holds at each level by itself.

    Args:
        beliefs: a colour each, with equally many ranks.
        samples: L.
    """
    count = len(beliefs[0].density_ranks)
    for belief in beliefs:
        if len(belief.density_ranks) != count or len(belief.value_ranks) != count:
            raise ForbesError(
                f"{belief.name}: {len(belief.value_ranks)} and {len(belief.density_ranks)} ranks, expected {count} as "
                f"for {beliefs[0].name}. Rank the same states under each belief"
            )
    with paper_style():
        figure = Figure((PAGE, 2.3), layout="constrained")
        histogram, difference, covered = figure.subplots(1, 3)
        _draw_histogram(histogram, beliefs, count, samples)
        _draw_difference(difference, beliefs, count, samples)
        _draw_coverage(covered, beliefs, count, samples)
        lines = [Line2D([], [], color=belief.colour, label=belief.name) for belief in beliefs]
        band = Patch(color=GREY, alpha=0.3, lw=0, label="calibrated, 95 %")
        figure.legend(handles=[*lines, band], loc="outside upper center", ncols=len(beliefs) + 1)
    return figure


def _draw_histogram(axes: Axes, beliefs: Sequence[RankedBelief], count: int, samples: int) -> None:
    """Draw the density of ranks; its band holds all bins together (Bonferroni: bins hardly depend on each other)."""
    bins = min(_BINS, samples + 1)
    bin_of = torch.arange(samples + 1) * bins // (samples + 1)  # (L + 1,)
    share = bin_of.bincount() / (samples + 1)  # (bins,), nearly equal
    edges = torch.nn.functional.pad(share.cumsum(0), (1, 0)).tolist()
    low, high = binomial_interval(count, share, 1 - (1 - _CONFIDENCE) / bins)
    axes.stairs((high / share).tolist(), edges, baseline=(low / share).tolist(), fill=True, color=GREY, alpha=0.3, lw=0)
    axes.axhline(1, color=BLACK, lw=0.6)
    for belief in beliefs:
        for ranks in belief.value_ranks.T:
            density = bin_of[ranks].bincount(minlength=bins) / count / share  # (bins,)
            axes.stairs(density.tolist(), edges, color=belief.colour, alpha=_alpha(belief), baseline=None)
    axes.set(xlabel="rank of the true value / L", ylabel="density of ranks", xlim=(0, 1))
    axes.set_ylim(bottom=0)


def _draw_difference(axes: Axes, beliefs: Sequence[RankedBelief], count: int, samples: int) -> None:
    """Draw the ranks' distribution function less that of uniform ranks."""
    uniform = torch.linspace(0, 1, samples + 2, dtype=torch.float64)  # (L + 2,), the share below rank 0, 1, ..., L + 1
    low, high = ecdf_band(count, samples, _CONFIDENCE, generator(0, "calibration figure", count))
    low, high = (torch.cat((uniform[:1], end, uniform[-1:])) - uniform for end in (low, high))  # (L + 2,)
    axes.fill_between(uniform, low, high, color=GREY, alpha=0.3, lw=0)
    axes.axhline(0, color=BLACK, lw=0.6)
    for belief in beliefs:
        for ranks in belief.value_ranks.T:
            below = torch.nn.functional.pad(ranks.bincount(minlength=samples + 1).double().cumsum(0), (1, 0)) / count
            axes.plot(uniform, below - uniform, color=belief.colour, alpha=_alpha(belief))
    axes.set(xlabel="rank of the true value / L", ylabel="ECDF − uniform", xlim=(0, 1))


def _draw_coverage(axes: Axes, beliefs: Sequence[RankedBelief], count: int, samples: int) -> None:
    """Draw how often the true value lies in the highest-density region of each level."""
    levels = torch.linspace(0, 1, _LEVELS, dtype=torch.float64)
    low, high = binomial_interval(count, levels, _CONFIDENCE)
    axes.fill_between(levels, low, high, color=GREY, alpha=0.3, lw=0)
    axes.plot([0, 1], [0, 1], color=BLACK, lw=0.6)
    for belief in beliefs:
        axes.plot(levels, coverage(belief.density_ranks, samples, levels), color=belief.colour)
    axes.set(xlabel="nominal level of the region", ylabel="true values within", xlim=(0, 1), ylim=(0, 1))
    axes.set_aspect("equal")


def _alpha(belief: RankedBelief) -> float:
    """Make many lines fainter."""
    return max(0.3, 1 / belief.value_ranks.shape[1])
