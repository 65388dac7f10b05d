"""What an agent imagined in an episode, next to what happened: frames for a video."""

import io

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from forbes.data.episodes.episode import Episode
from forbes.figures.style import BLACK, GREY, ORANGE, paper_style
from forbes.models import StateSpaceModel
from forbes.seeding import forked
from forbes.shapes import map_parts

__all__ = ["curves", "dream"]

_CURVES = 8
"""Maximal number of dimensions of a vector that are drawn."""
_DPI = 100


@torch.no_grad()
def dream(model: StateSpaceModel, episode: Episode, horizon: int, seed: int) -> Tensor:
    r"""Return what the model expected to observe at each step of an episode, imagined for the actions that were taken.

    Every `horizon` steps the model filters all observations so far, shows :math:`E[o_t \mid h_t, s_t]` of the sample
    of its belief, and imagines the next steps from it.

    Args:
        model: world model of the agent.
        episode: an episode of T + 1 observations.
        horizon: number of imagined steps, H.
        seed: random seed of the samples.

    Returns:
        Means of the observations, `(T + 1, *O)`, in units of the likelihood.
    """
    device = model.initial(1).state.device
    observation = map_parts(lambda array: torch.from_numpy(array.copy()).to(device)[None], episode.observation)
    action = torch.from_numpy(episode.action.copy()).to(device)[None]  # (1, T + 1, A)
    steps = action.shape[1]
    with forked(device, seed):
        filtered = model.filter(model.embed(observation), action)
        features = []
        for first in range(0, steps, horizon + 1):
            features.append(filtered.features[:, first : first + 1])
            taken = action[:, first + 1 : first + 1 + horizon]  # (1, at most H, A)
            if taken.shape[1] > 0:
                features.append(model.imagine(filtered.at(first), taken).features)
        return model.likelihood.mean(model.decode(torch.cat(features, 1)))[0]  # (T + 1, *O)


def curves(seen: NDArray[np.float32], imagined: NDArray[np.float32], horizon: int, height: int) -> NDArray[np.uint8]:
    """Draw vectors over time, what was observed and what was imagined, with a line at the present step.

    Args:
        seen: observations, `(T, O)`; the first eight dimensions are drawn.
        imagined: means of `dream`, `(T, O)`.
        horizon: number of imagined steps, H; the imagination starts again every H + 1 steps.
        height: height of the frames in pixels.

    Returns:
        Frames, uint8 `(T, 3, height, 1.5 height)`.
    """
    time, count = np.arange(len(seen)), min(seen.shape[1], _CURVES)
    with paper_style():
        figure = Figure((1.5 * height / _DPI, height / _DPI), dpi=_DPI, layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
        for index, axis in enumerate(axes):
            axis.plot(time, seen[:, index], color=BLACK, lw=0.8)
            for first in range(0, len(seen), horizon + 1):  # a gap where the imagination starts again
                part = slice(first, first + horizon + 1)
                axis.plot(time[part], imagined[part, index], color=ORANGE, lw=0.8)
            axis.set_ylabel(str(index), rotation=0, labelpad=6, fontsize=6, va="center")
            axis.set_yticks([])
            axis.tick_params(labelsize=6)
            axis.margins(x=0)
        axes[-1].set_xlabel("agent step", fontsize=6)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=_DPI)
        picture = np.asarray(Image.open(file).convert("RGB")).transpose(2, 0, 1)  # (3, H, W)
        top, bottom = (round(height - edge) for edge in (axes[0].bbox.y1, axes[-1].bbox.y0))  # pixels
        left, right = (axes[0].transData.transform((at, 0))[0] for at in (0, max(1, len(seen) - 1)))  # pixels
    frames = picture[None].repeat(len(seen), 0)
    grey = int(GREY[1:3], 16)
    for step, column in enumerate(np.linspace(left, right, len(seen)).round().astype(int)):
        frames[step, :, top:bottom, min(column, picture.shape[2] - 1)] = grey
    return frames
