"""Videos: frames next to each other in a grid, and files that play."""

import io
from pathlib import Path

import numpy as np
import pytest

from forbes.errors import ForbesError
from forbes.figures import video
from forbes.figures.video import captioned, enlarged, mp4, require_format, side_by_side, tiled


def episode(length, colour, side=8):
    """Frames of one colour, darker with time."""
    frames = np.full((length, 3, side, side), colour, np.uint8)
    return frames - np.arange(length, dtype=np.uint8)[:, None, None, None]


@pytest.mark.parametrize(("count", "rows", "columns"), [(1, 1, 1), (2, 1, 2), (3, 2, 2), (4, 2, 2), (5, 2, 3)])
def test_a_grid_shows_all_episodes_at_once(count, rows, columns):
    episodes = [episode(3 + k, 40 * (k + 1)) for k in range(count)]

    grid = tiled(episodes)

    assert grid.shape == (2 + count, 3, 8 * rows, (8 + 4) * columns + 4)
    for number, one in enumerate(episodes):
        row, column = divmod(number, columns)
        cell = grid[:, :, 8 * row : 8 * row + 8, 4 + 12 * column : 12 + 12 * column]
        np.testing.assert_array_equal(cell[: len(one)], one)
        np.testing.assert_array_equal(cell[len(one) :], one[-1:].repeat(2 + count - len(one), 0))  # its last frame


def test_side_by_side_and_captions_keep_the_frames():
    one, other = episode(3, 100), episode(2, 200)

    both = side_by_side([one, other])
    named = captioned(one, "a name")

    np.testing.assert_array_equal(both[:, :, :, 4:12], one)
    np.testing.assert_array_equal(both[:2, :, :, 16:24], other)
    np.testing.assert_array_equal(named[:, :, 14:], one)
    assert (named[:, :, :14] < 255).any()  # text


def test_an_mp4_without_pyav_is_refused(monkeypatch):
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    require_format(Path("agent.gif"))

    with pytest.raises(ForbesError, match=r"--video agent.mp4: an MP4 needs PyAV. pip install 'forbes\[video\]'"):
        require_format(Path("agent.mp4"))


@pytest.mark.parametrize("shape", [(3, 8, 8), (1, 9, 15)])
def test_an_mp4_holds_the_frames_and_a_pause(shape):
    av = pytest.importorskip("av")
    frames = np.array([0, 60, 120, 180, 240], np.uint8)[:, None, None, None] * np.ones((1, *shape), np.uint8)

    with av.open(io.BytesIO(mp4([frames, frames[:2]]))) as container:
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        rate = container.streams.video[0].average_rate

    assert rate == 25
    assert len(shown) == 5 + 24 + 2 + 24  # the last frame of an episode stays for a second
    height, width = enlarged(frames).shape[2:]
    assert shown[0].shape == (height + height % 2, width + width % 2, 3)
    levels = [int(frame.mean().round()) for frame in (*shown[:5], shown[-1])]
    np.testing.assert_allclose(levels, [0, 60, 120, 180, 240, 60], atol=4)  # YUV of 8 bits, lossy
