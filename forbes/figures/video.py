"""Episodes as moving pictures: animated GIF, which needs no codec and is shown everywhere."""

import io
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from forbes.figures.episodes import to_rgb

__all__ = ["gif"]

_FRAME, _LAST_FRAME = 40, 1000
"""Milliseconds of a frame, and of the last one of an episode."""
_SIDE = 256
"""Pixels that a frame has at least, by enlarging every pixel to a square."""


def gif(episodes: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return the content of a GIF of episodes, one after the other, at 25 frames a second, for ever.

    A frame has a palette of its own, of 256 colours. A frame like the one before it is not stored but shown for longer.

    Args:
        episodes: the frames of each, all of one size, uint8 `(T, C, H, W)`, C as `to_rgb` takes it.
    """
    first, *others = (picture for episode in episodes for picture in _pictures(episode))
    durations = [_LAST_FRAME if last else _FRAME for one in episodes for last in (*[False] * (len(one) - 1), True)]
    content = io.BytesIO()
    first.save(content, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return content.getvalue()


def _pictures(episode: NDArray[np.uint8]) -> Iterator[Image.Image]:
    height, width = episode.shape[2:]
    factor = -(-_SIDE // max(height, width))
    for frame in episode:
        colours = to_rgb(frame).transpose(1, 2, 0)  # (H, W, 3)
        picture = Image.fromarray(np.ascontiguousarray(colours)).quantize(256)
        yield picture.resize((factor * width, factor * height), Image.Resampling.NEAREST)
