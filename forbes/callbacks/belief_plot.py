"""Plot prior and posterior beliefs along a digit."""

import math
from collections.abc import Callable
from typing import NamedTuple, cast

import torch
from lightning import LightningModule, Trainer
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import blended_transform_factory
from torch import Tensor

from forbes.beliefs import BeliefHead
from forbes.callbacks.picture import PictureCallback, require_one_array, require_state, require_validation
from forbes.data import SequenceDataModule
from forbes.errors import ForbesError, require_at_least
from forbes.evaluation.predictions import first_of_each_class
from forbes.figures.prediction_grid import colour_of
from forbes.figures.style import BLACK, GREY, PAGE, density_map, paper_style
from forbes.models import StateSpaceModel
from forbes.training.world_model import WorldModel

__all__ = ["BeliefPlot"]

_GRID = 64  # points along each axis of a density
_DOTS = 200  # samples shown


class BeliefPlot(PictureCallback):
    """Draws `figures/beliefs.png`: frame, prior p(s_t | h_t) and posterior q(s_t | h_t, o_t) at some steps of a digit.

    Each panel shows density and samples. The prior's panel also shows samples of the posterior, in its colour. For a
    two-dimensional state the density is exact. For more dimensions samples are projected on the prior's two leading
    principal components (labelled with their fraction of the variance), and the density is a kernel estimate. For a
    `ParticleModel` it shows one trajectory of the proposal. A `VectorModel` has no state to plot.

    Args:
        digits: number of digits, the first of each class of the validation split.
        columns: number of steps shown, evenly spaced from the first to the last.
        samples: number of samples of each belief.
        every: number of epochs between plots.
    """

    filename = "beliefs.png"

    def __init__(self, digits: int = 2, columns: int = 6, samples: int = 2000, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "BeliefPlot", digits=digits, columns=columns)
        require_at_least(3, "BeliefPlot", samples=samples)
        self.digits, self.columns, self.samples = digits, columns, samples

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse a model without a state of two dimensions, and data that cannot be drawn, when the training starts."""
        require_one_array(self, trainer)
        require_validation(self, trainer)
        require_state(self, pl_module)
        if (dimensions := cast(StateSpaceModel, pl_module.model).state_dim) < 2:
            raise ForbesError(f"BeliefPlot: state_dim is {dimensions}, expected at least 2. Remove this callback")

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw the beliefs along the first digits of the validation split."""
        model = module.model
        assert isinstance(model, StateSpaceModel)
        index = first_of_each_class(data, "validation", self.digits)
        batch = data.sequences("validation", index).to(module.device)
        pictures = data.source.pictures(batch.observation)
        filtered = model.filter(model.embed(batch.observation), batch.action)
        prior_context = model.prior_context(filtered.hidden)  # (B, T, C)
        times = torch.linspace(0, data.length - 1, self.columns).round().long().unique().tolist()
        with paper_style():
            heights = (0.3, *[3.3] * len(index))
            figure = Figure((PAGE, sum(heights)))
            head, *parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights).flat
            head.legend(handles=_legend(colour_of(model)), loc="center", ncols=4)
            for digit, part in enumerate(parts):
                rows = part.subplots(3, len(times), squeeze=False, gridspec_kw={"wspace": 0.3, "hspace": 0.22})
                part.subplots_adjust(left=0.06, right=0.97, bottom=0.11, top=0.95)
                for column, time in enumerate(times):
                    _draw_frame(rows[0, column], pictures[digit, time], f"t = {time + 1}")
                    prior = self._sample(model.prior, prior_context[digit, time])
                    posterior = self._sample(model.posterior, filtered.context[digit, time])
                    _draw_beliefs(rows[1, column], rows[2, column], prior, posterior, colour_of(model), column == 0)
        return figure

    def _sample(self, head: BeliefHead, context: Tensor) -> "_Cloud":
        samples, _ = head.rsample(context, (self.samples,))  # (N, D)

        def exact(x: Tensor, y: Tensor) -> Tensor:
            points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).to(samples)  # (Y, X, 2)
            return head.log_prob(points, context).exp().cpu()  # (Y, X)

        return _Cloud(samples.cpu(), exact)


class _Cloud(NamedTuple):
    """Samples of a belief, and its density in a plane."""

    samples: Tensor
    """Samples, `(N, D)`, or `(N, 2)` in a plane."""
    density: Callable[[Tensor, Tensor], Tensor]
    """Density on a grid: x, `(X,)`, and y, `(Y,)`, to `(Y, X)`."""


def _draw_beliefs(above: Axes, below: Axes, prior: _Cloud, posterior: _Cloud, colour: str, named: bool) -> None:
    """Draw prior, in grey, and posterior in one plane, each in its own frame."""
    kind, plane = "exact density", "$s_1$, $s_2$"
    if prior.samples.shape[1] > 2:
        prior, posterior, plane = _principal_plane(prior.samples, posterior.samples)
        kind = "KDE"
    _draw_cloud(above, prior, GREY, torch.cat((prior.samples, posterior.samples)))
    above.plot(*posterior.samples[:_DOTS].numpy().T, ".", color=colour, markersize=1, alpha=0.6)
    _draw_cloud(below, posterior, colour, posterior.samples)
    below.set_xlabel(plane, fontsize=6)
    if named:
        for axes, name, its_colour in ((above, "prior", GREY), (below, "posterior", colour)):
            axes.set_ylabel(f"{name}, {kind}", color=its_colour, fontsize=6)
            at_the_edge = blended_transform_factory(axes.figure.transSubfigure, axes.transAxes)
            axes.yaxis.set_label_coords(0.02, 0.5, transform=at_the_edge)


def _draw_cloud(axes: Axes, cloud: _Cloud, colour: str, shown: Tensor) -> None:
    """Draw a density with some of its samples, in a frame around the points `shown`."""
    low, high = shown.quantile(0.002, 0), shown.quantile(0.998, 0)  # (2,), (2,)
    margin = 0.15 * (high - low) + 1e-6
    (left, bottom), (right, top) = (low - margin).tolist(), (high + margin).tolist()
    density = cloud.density(torch.linspace(left, right, _GRID), torch.linspace(bottom, top, _GRID)).numpy()  # (Y, X)
    extent = (left, right, bottom, top)
    axes.imshow(
        density, extent=extent, origin="lower", aspect="auto", cmap=density_map(colour), interpolation="bilinear"
    )
    axes.plot(*cloud.samples[:_DOTS].numpy().T, ".", color=BLACK, markersize=1, alpha=0.35)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.locator_params(nbins=3)
    axes.tick_params(labelsize=5, length=2, pad=1)
    axes.grid(False)


def _legend(colour: str) -> list[Artist]:
    """Return the entries of the legend, with the posterior in `colour`."""
    samples = (
        Line2D([], [], color=its_colour, label=label, linestyle="", marker=".", markersize=4)
        for its_colour, label in ((BLACK, "samples of the density"), (colour, "samples of the posterior"))
    )
    return [Patch(color=GREY, label="prior, density"), Patch(color=colour, label="posterior, density"), *samples]


def _draw_frame(axes: Axes, observation: Tensor, title: str) -> None:
    axes.imshow(observation.float().mean(0).cpu().numpy(), cmap="gray_r", vmin=0)
    axes.set_title(title, pad=2)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color=GREY, linewidth=0.4)
    axes.grid(False)


def _principal_plane(prior: Tensor, posterior: Tensor) -> tuple[_Cloud, _Cloud, str]:
    """Project samples, each `(N, D)`, on the prior's two leading principal components, and return an axis label."""
    centre = prior.mean(0)
    _, strength, directions = torch.linalg.svd(prior - centre, full_matrices=False)  # (D,), (D, D)
    fraction = strength.square() / strength.square().sum()
    planar = [(samples - centre) @ directions[:2].T for samples in (prior, posterior)]  # 2 x (N, 2)
    first, second = (_Cloud(samples, _kernel_density(samples)) for samples in planar)
    return first, second, f"PC 1 ({fraction[0]:.0%}), PC 2 ({fraction[1]:.0%})"


def _kernel_density(samples: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    r"""Estimate a density from samples, `(N, 2)`: Gaussian kernels of width :math:`N^{-1/6}\,\sigma_d` (Scott)."""
    widths = samples.std(0) / math.pow(len(samples), 1 / 6) + 1e-12

    def kernels(points: Tensor, axis: int) -> Tensor:
        distance = (points[:, None] - samples[:, axis]) / widths[axis]  # (P, N)
        return distance.square().mul(-0.5).exp() / (math.sqrt(2 * math.pi) * widths[axis])

    return lambda x, y: kernels(y, 1) @ kernels(x, 0).T / len(samples)  # (Y, X)
