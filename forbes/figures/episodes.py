"""Draw episodes as strips of frames."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode
from forbes.models.parts import side_by_side
from forbes.shapes import Observed

__all__ = ["MAX_CHANNELS", "draw_strips", "frames_of", "to_rgb"]

T = TypeVar("T", bound=np.generic)

MAX_CHANNELS = 4
"""Maximal number of channels of a frame that can be drawn."""
_FRAMES = 10


def to_rgb(frames: NDArray[T]) -> NDArray[T]:
    """Convert frames `(*, C, H, W)` of any dtype and range to three colours, `(*, 3, H, W)`.

    One channel is grey. Two channels are red and cyan, so white stays white. The last of four channels (opacity or
    depth) is dropped.
    """
    shown = {1: [0, 0, 0], 2: [0, 1, 1]}.get(frames.shape[-3], [0, 1, 2])
    return frames[..., shown, :, :]  # (*, 3, H, W)


def frames_of(observation: Observed) -> NDArray[np.uint8]:
    """Return the images of stored observations, uint8 `(T, C, H, W)`; those of several parts side by side."""
    if not isinstance(observation, dict):
        frames: NDArray[np.uint8] = observation
        return frames
    images = [torch.from_numpy(observation[name].copy()) for name in sorted(observation) if observation[name].ndim == 4]
    joined: NDArray[np.uint8] = side_by_side(images).numpy()
    return joined


def draw_strips(episodes: Sequence[tuple[str, Episode]]) -> Figure:
    """Draw one row per episode: ten frames, evenly spaced from the first to the last, with their time."""
    figure = Figure(figsize=(1.0 * _FRAMES, 1.25 * len(episodes)), layout="constrained")
    axes = figure.subplots(len(episodes), _FRAMES, squeeze=False)
    for row, (name, episode) in zip(axes, episodes, strict=True):
        times = np.linspace(0, len(episode.reward) - 1, _FRAMES).round().astype(int)
        frames = frames_of(episode.observation)
        for axis, time in zip(row, times, strict=True):
            axis.imshow(to_rgb(frames[time]).transpose(1, 2, 0))  # (H, W, 3)
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"t = {time}", fontsize=7)
        row[0].set_ylabel(name, fontsize=7)
    return figure
