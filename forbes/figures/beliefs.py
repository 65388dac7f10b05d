r"""Figure 1 of the paper: beliefs over time next to the exact one, of processes whose exact belief is known.

The state of a learned world model is its own, so its belief cannot be compared with that of the process directly. But
where both have Gaussian noise of the same width, p(o_1, …, o_T) determines the distribution of the observations without
their noise, E[o_t | s_t] (a convolution with a Gaussian can be inverted). A world model that has learned the data has
the exact belief over these. They are the position of the hiker, and the distance of the mirror sensor from zero, whose
sign no world model can learn. For a `KnownBelief` the figure has the belief over the true state itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from forbes.data import SequenceData
from forbes.errors import ForbesError
from forbes.evaluation.belief_errors import belief_errors, moment_matched
from forbes.figures.belief_samples import LearnedSamples, exact_belief, known_beliefs, world_models
from forbes.figures.style import BLACK, PAGE, Method, density_map, method_styles, paper_style
from forbes.pomdps import Process
from forbes.runs.folder import RunFolder, read_config
from forbes.seeding import generator

__all__ = ["DrawnBelief", "beliefs_over_time", "draw_beliefs", "least_gaussian"]

_CANDIDATES, _ROWS, _POINTS = 200, 20, 200
"""Number of test sequences to choose from, sequences filtered at a time, and samples of their beliefs."""
_SAMPLES = 8000
"""Number of samples of each belief drawn."""
_LINE_BINS, _PLANE_BINS = 100, 32
_EXACT = "exact belief"


class DrawnBelief(NamedTuple):
    """A belief at some steps of one sequence."""

    name: str
    style: Method
    points: Tensor
    """Samples, `(N, T, D)`, D 1 or 2."""


def draw_beliefs(runs: Sequence[str], index: Sequence[int] = ()) -> dict[str, Figure]:
    """Draw `beliefs_over_time` of one sequence: the exact belief, and that of each run.

    Args:
        runs: run folders of world models, or of `KnownBelief`s, all of the same known process.
        index: the test sequence to draw. Default: the one whose exact beliefs are farthest from Gaussians
            (`least_gaussian`), which does not depend on any model.

    Raises:
        ForbesError: if the runs are of both kinds or of different data, or if their beliefs cannot be compared with
            the exact one.
    """
    learned = _learned(runs)
    data, process, values = learned[0].data, learned[0].process, learned[0].values
    chosen = _index(data, index) if index else least_gaussian(data, process)
    batch = data.sequences("test", torch.tensor([chosen]))
    truth = values(batch.state[0].double())  # (T, D)
    times = _times(truth.shape[-1], data.length)
    steps = [time - 1 for time in times]
    states = exact_belief(process, batch).sample(_SAMPLES, generator(0, "exact belief", chosen))  # (N, 1, T, D)
    points = {_EXACT: values(states[:, 0])[:, steps]}
    points |= {one.name: one.sample(batch, times, _SAMPLES) for one in learned}
    styles = method_styles([*points])
    beliefs = [DrawnBelief(name, styles[name], each) for name, each in points.items()]
    return {"beliefs": beliefs_over_time(beliefs, truth[steps], times, learned[0].label)}


def _learned(runs: Sequence[str]) -> Sequence[LearnedSamples]:
    """Load the runs, which must be all of one kind."""
    kinds = [read_config(RunFolder(run).config)["model"]["class_path"].rpartition(".")[2] for run in runs]
    known = [kind == "KnownBelief" for kind in kinds]
    if any(known) and not all(known):
        raise ForbesError(
            f"{runs[known.index(False)]}: is a world model, and {runs[known.index(True)]} the belief of a known "
            "process, expected one kind, since only the second is over the true state. Draw each kind separately"
        )
    return known_beliefs(runs) if all(known) else world_models(runs)


def _index(data: SequenceData, index: Sequence[int]) -> int:
    size = data.source.size("test")
    if len(index) > 1 or not 0 <= index[0] < size:
        found = " ".join(map(str, index))
        raise ForbesError(f"--index {found}: expected one test sequence, 0 to {size - 1}. Name one")
    return index[0]


def least_gaussian(data: SequenceData, process: Process) -> int:
    """Return the test sequence, of the first 200, whose exact beliefs are farthest from Gaussians.

    The distance is the forward KL of the Gaussian with the same mean and variance, in nats, summed over the steps.
    """
    count = min(_CANDIDATES, data.source.size("test"))
    totals = []
    for index in torch.arange(count).split(_ROWS):
        batch = data.sequences("test", index)
        exact, draw = exact_belief(process, batch), generator(0, "least Gaussian", int(index[0]))
        errors = belief_errors(exact, moment_matched(exact), batch.state.double(), None, _POINTS, draw)
        totals.append(errors["forward_kl"].sum(1))  # (B,)
    return int(torch.cat(totals).argmax())


def beliefs_over_time(beliefs: Sequence[DrawnBelief], truth: Tensor, times: Sequence[int], label: str) -> Figure:
    """Draw beliefs side by side, as densities of their samples; black is the true value.

    In one dimension, time runs to the right in one panel per belief. In two dimensions there is a row per belief, and
    a column per step. The shade is the square root of the density, white at 0 and darkest at the maximum of the
    first belief at this step.

    Args:
        beliefs: beliefs at the same steps, the exact one first.
        truth: true values at these steps, `(T, D)`.
        times: the steps, counted from 1.
        label: what is drawn, with its unit.
    """
    draw = _draw_lines if truth.shape[-1] == 1 else _draw_planes
    with paper_style():
        return draw(beliefs, truth, times, label)


def _draw_lines(beliefs: Sequence[DrawnBelief], truth: Tensor, times: Sequence[int], label: str) -> Figure:
    figure = Figure((PAGE, 2.1), layout="constrained")
    panels = figure.subplots(1, len(beliefs), sharex=True, sharey=True)
    low, high = _frame(beliefs, truth)
    extent = (times[0] - 0.5, times[-1] + 0.5, low[0].item(), high[0].item())
    densities = [
        torch.stack([_density(belief.points[:, t], low, high, _LINE_BINS) for t in range(len(times))], 1)  # (bins, T)
        for belief in beliefs
    ]
    darkest = densities[0].amax(0)  # (T,)
    for axes, belief, density in zip(panels, beliefs, densities, strict=True):
        _shade(axes, density / darkest, belief.style.colour, extent)
        axes.plot(times, truth[:, 0], color="white", lw=1.6, alpha=0.7)
        (line,) = axes.plot(times, truth[:, 0], color=BLACK, lw=0.7, ls="--", label="true value")
        axes.set_title(belief.name, color=belief.style.colour)
        axes.set_xlabel("step t")
    panels[0].set_ylabel(label)
    figure.legend(handles=[line], loc="outside lower right")
    return figure


def _draw_planes(beliefs: Sequence[DrawnBelief], truth: Tensor, times: Sequence[int], label: str) -> Figure:
    width = PAGE / len(times)
    figure = Figure((PAGE, width * len(beliefs) + 0.35), layout="constrained")
    rows = figure.subplots(len(beliefs), len(times), sharex=True, sharey=True, squeeze=False)
    low, high = _frame(beliefs, truth)
    (left, bottom), (right, top) = low.tolist(), high.tolist()
    for column, time in enumerate(times):
        densities = [_density(belief.points[:, column], low, high, _PLANE_BINS) for belief in beliefs]  # (Y, X)
        for axes, belief, density in zip(rows[:, column], beliefs, densities, strict=True):
            _shade(axes, density / densities[0].max(), belief.style.colour, (left, right, bottom, top))
            axes.plot(*truth[column], "+", color=BLACK, markersize=5, markeredgewidth=0.8)
            axes.locator_params(nbins=3)
        rows[0, column].set_title(f"t = {time}")
    for axes, belief in zip(rows[:, 0], beliefs, strict=True):
        axes.set_ylabel(belief.name, color=belief.style.colour)
    figure.supxlabel(f"{label}; + is the true one", fontsize=8)
    return figure


def _frame(beliefs: Sequence[DrawnBelief], truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest values to draw, `(D,)` each."""
    ends = [belief.points.flatten(0, 1).double().quantile(share, 0) for belief in beliefs for share in (0.005, 0.995)]
    shown = torch.cat((torch.stack(ends), truth))  # (2 beliefs + T, D)
    margin = 0.06 * (shown.amax(0) - shown.amin(0)) + 1e-6
    return shown.amin(0) - margin, shown.amax(0) + margin


def _density(points: Tensor, low: Tensor, high: Tensor, bins: int) -> Tensor:
    """Return the histogram of samples `(N, D)` as a density: `(bins,)`, or `(Y, X)` in two dimensions."""
    ranges = torch.stack((low, high), 1).flatten().tolist()
    counts, _ = torch.histogramdd(points.double(), [bins] * len(low), range=ranges)  # (X,) or (X, Y)
    volume = ((high - low) / bins).prod()
    return counts.T / len(points) / volume if len(low) == 2 else counts / len(points) / volume


def _shade(axes: Axes, density: Tensor, colour: str, extent: tuple[float, float, float, float]) -> None:
    """Draw a density relative to the darkest. The root makes a wide belief visible next to a narrow one."""
    shade = density.sqrt().numpy()
    axes.imshow(shade, density_map(colour), vmin=0, vmax=1, aspect="auto", origin="lower", extent=extent)
    axes.grid(False)


def _times(dim: int, length: int) -> list[int]:
    """Return the steps to draw, counted from 1: all in one dimension, else the powers of two and the last."""
    if dim == 1:
        return list(range(1, length + 1))
    if dim == 2:
        return sorted({*(2**power for power in range(length.bit_length()) if 2**power < 0.75 * length), length})
    raise ForbesError(f"forbes figures beliefs: a belief over {dim} dimensions, expected 1 or 2. Name other runs")
