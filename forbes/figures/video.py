"""Episodes as videos: animated GIFs, which need no codec and are displayed everywhere, or MP4."""

import io
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from forbes.errors import ForbesError
from forbes.figures.episodes import to_rgb
from forbes.rounding import ceil_div

__all__ = ["FORMATS", "captioned", "enlarged", "gif", "mp4", "require_format", "side_by_side", "tiled"]

_FRAME, _LAST_FRAME = 40, 1000
"""Duration of a frame and of the last frame of an episode, in milliseconds."""
_SIDE = 256
"""Minimal side of a frame in pixels. Smaller frames are enlarged by an integer factor."""
_GAP, _STRIP, _WHITE = 4, 14, 255
"""Pixels between frames next to each other and of the strip of a caption, and their colour."""


def gif(episodes: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return the content of a GIF that shows episodes one after the other, at 25 frames per second, in a loop.

    Each frame has its own palette of 256 colours. Repeated frames are stored once, with a longer duration.

    Args:
        episodes: frames of each episode, all of one size, uint8 `(T, C, H, W)`, with C channels as in `to_rgb`.
    """
    first, *others = (
        Image.fromarray(np.ascontiguousarray(frame.transpose(1, 2, 0))).quantize(256)  # (H, W, 3)
        for episode in episodes
        for frame in enlarged(episode)
    )
    durations = []
    for episode in episodes:
        durations += [_FRAME] * (len(episode) - 1) + [_LAST_FRAME]
    content = io.BytesIO()
    first.save(content, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return content.getvalue()


def mp4(episodes: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return the content of an MP4 (H.264) that shows episodes one after the other, at 25 frames per second.

    Args:
        episodes: frames of each episode, as for `gif`.
    """
    import av  # an extra of this package

    content = io.BytesIO()
    with av.open(content, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=1000 // _FRAME, options={"crf": "18"})
        stream.pix_fmt = "yuv420p"  # what every player shows; its sides are even
        height, width = enlarged(episodes[0][:1]).shape[2:]
        stream.height, stream.width = height + height % 2, width + width % 2
        for frame in _with_pauses(episodes):
            shown = np.pad(frame, ((0, 0), (0, height % 2), (0, width % 2)), mode="edge")
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(shown.transpose(1, 2, 0)), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return content.getvalue()


FORMATS: dict[str, Callable[[Sequence[NDArray[np.uint8]]], bytes]] = {".gif": gif, ".mp4": mp4}
"""Functions that write a video, by the ending of its file."""


def require_format(path: Path) -> None:
    """Raise a ForbesError unless a video of this name can be written."""
    if path.suffix not in FORMATS:
        found, expected = path.suffix or "nothing", " or ".join(FORMATS)
        raise ForbesError(f"--video {path}: it ends in {found}, expected {expected}. Rename it")
    if path.suffix == ".mp4" and find_spec("av") is None:
        raise ForbesError(f"--video {path}: an MP4 needs PyAV. pip install 'forbes[video]', or write a .gif")


def _with_pauses(episodes: Sequence[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """Yield all frames `(3, H, W)`, the last one of an episode for a second."""
    for episode in episodes:
        frames = enlarged(episode)
        yield from frames
        yield from [frames[-1]] * (_LAST_FRAME // _FRAME - 1)


def enlarged(episode: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return frames `(T, C, H, W)` in three colours, of at least 256 pixels a side, `(T, 3, k H, k W)`."""
    factor = ceil_div(_SIDE, max(episode.shape[2:]))
    return to_rgb(episode).repeat(factor, 2).repeat(factor, 3)


def captioned(episode: NDArray[np.uint8], caption: str) -> NDArray[np.uint8]:
    """Write a line of text above frames: `(T, 3, H, W)` to `(T, 3, 14 + H, W)`."""
    strip = Image.new("RGB", (episode.shape[3], _STRIP), (_WHITE,) * 3)
    ImageDraw.Draw(strip).text((2, 1), caption, fill=(0, 0, 0))
    above = np.asarray(strip).transpose(2, 0, 1)[None].repeat(len(episode), 0)  # (T, 3, 14, W)
    return np.concatenate((above, episode), 2)


def side_by_side(episodes: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Show episodes of one height at the same time: T x `(3, H, W)` each to `(max T, 3, H, sum W + gaps)`.

    An episode that has ended keeps its last frame.
    """
    longest, height = max(map(len, episodes)), episodes[0].shape[2]
    gap = np.full((longest, 3, height, _GAP), _WHITE, np.uint8)
    columns = [gap]
    for episode in episodes:
        last = episode[-1:].repeat(longest - len(episode), 0)
        columns += [np.concatenate((episode, last)), gap]
    return np.concatenate(columns, 3)


def tiled(episodes: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Show episodes of one size at the same time in a grid, as square as can be, `(max T, 3, R H, C W)` with gaps."""
    columns = next(number for number in range(1, len(episodes) + 1) if number**2 >= len(episodes))
    blank = np.full_like(episodes[0][:1], _WHITE)
    padded = [*episodes, *[blank] * (-len(episodes) % columns)]
    longest = max(map(len, episodes))
    rows = [side_by_side([*padded[first : first + columns]]) for first in range(0, len(padded), columns)]
    equal = [np.concatenate((row, row[-1:].repeat(longest - len(row), 0))) for row in rows]
    return np.concatenate(equal, 2)
