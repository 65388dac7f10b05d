"""Episodes as animated GIFs, which need no codec and are displayed everywhere."""

import io
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from forbes.figures.episodes import to_rgb
from forbes.rounding import ceil_div

__all__ = ["gif"]

_FRAME, _LAST_FRAME = 40, 1000
"""Duration of a frame and of the last frame of an episode, in milliseconds."""
_SIDE = 256
"""Minimal side of a frame in pixels. Smaller frames are enlarged by an integer factor."""


def gif(episodes: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return the content of a GIF that shows episodes one after the other, at 25 frames per second, in a loop.

    Each frame has its own palette of 256 colours. Repeated frames are stored once, with a longer duration.

    Args:
        episodes: frames of each episode, all of one size, uint8 `(T, C, H, W)`, with C channels as in `to_rgb`.
    """
    first, *others = (picture for episode in episodes for picture in _pictures(episode))
    durations = []
    for episode in episodes:
        durations += [_FRAME] * (len(episode) - 1) + [_LAST_FRAME]
    content = io.BytesIO()
    first.save(content, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return content.getvalue()


def _pictures(episode: NDArray[np.uint8]) -> Iterator[Image.Image]:
    height, width = episode.shape[2:]
    factor = ceil_div(_SIDE, max(height, width))
    for frame in episode:
        colours = to_rgb(frame).transpose(1, 2, 0)  # (H, W, 3)
        picture = Image.fromarray(np.ascontiguousarray(colours)).quantize(256)
        yield picture.resize((factor * width, factor * height), Image.Resampling.NEAREST)
