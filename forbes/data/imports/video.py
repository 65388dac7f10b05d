"""Decode videos by PyAV, one frame at a time."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.data.imports.reader import imported
from forbes.errors import ForbesError

__all__ = ["VIDEOS", "decoded", "frame_rate"]

VIDEOS = (".mp4", ".mkv", ".avi", ".webm", ".mov")


def frame_rate(path: Path) -> float:
    """Return the number of frames per second of a video."""
    with imported("av", "video").open(str(path)) as container:
        return float(container.streams.video[0].average_rate)


def decoded(path: Path, start: float = 0.0, count: int | None = None) -> Iterator[NDArray[np.uint8]]:
    """Yield frames of a video, uint8 `(H, W, 3)`.

    Args:
        path: the video.
        start: time of the first frame, in seconds.
        count: number of frames. Default: all.

    Raises:
        ForbesError: if there are fewer frames.
    """
    found = 0
    with imported("av", "video").open(str(path)) as container:
        stream: Any = container.streams.video[0]
        half = 0.5 / float(stream.average_rate)  # of a frame
        if start:
            container.seek(int(start / stream.time_base), stream=stream)  # to the key frame before it
        for frame in container.decode(stream):
            if found == count:
                break
            if frame.time >= start - half:
                found += 1
                yield frame.to_ndarray(format="rgb24")
    if count is not None and found < count:
        raise ForbesError(f"{path}: has {found} frames from {start:g} s on, expected {count}")
