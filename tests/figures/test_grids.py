"""Frames of one to four channels, and of sides that differ, in every picture that has frames."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from forbes.errors import ForbesError
from forbes.figures.episodes import draw_strips, to_rgb
from forbes.figures.grids import Panel, draw_bands, draw_panels, require_images
from forbes.figures.imagination import draw_futures, draw_open_loop
from forbes.figures.style import BLUE
from forbes.figures.video import gif

CHANNELS = pytest.mark.parametrize("channels", [1, 2, 3, 4])
HEIGHT, WIDTH = 6, 10


def frames(*shape, channels):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(*shape, channels, HEIGHT, WIDTH, generator=generator)


@pytest.mark.parametrize(("channels", "colours"), [(1, [1, 1, 1]), (2, [1, 2, 2]), (3, [1, 2, 3]), (4, [1, 2, 3])])
def test_channels_become_three_colours(channels, colours):
    values = np.arange(1, channels + 1, dtype=np.uint8).reshape(1, channels, 1, 1)

    shown = to_rgb(values)

    assert shown.dtype == np.uint8
    assert shown.tolist() == np.reshape(colours, (1, 3, 1, 1)).tolist()


@CHANNELS
def test_a_panel_shows_each_frame_in_its_place(channels):
    images = frames(2, 3, channels=channels)

    figure = draw_panels([Panel("frames", images, "black")])

    picture = np.asarray(figure.axes[0].images[0].get_array())
    assert picture.shape == (2 * (HEIGHT + 2) + 2, 3 * (WIDTH + 2) + 2, 3)
    last = picture[HEIGHT + 4 : -2, 2 * WIDTH + 6 : -2]
    values = images[1, 2].numpy()
    np.testing.assert_allclose(last.transpose(2, 0, 1), 1 - to_rgb(values) if channels == 1 else to_rgb(values))


def test_long_titles_are_broken_into_lines_that_overlap_neither_each_other_nor_a_picture():
    names = ["FORBES (runs/strokes/forbes-40000-0)", "FORBES (pretrained/strokes-forbes), t = 30", "FORBES"]
    panels = [Panel(name, frames(2, 3, channels=1), "black") for name in names]

    figure = draw_bands([panels, panels])

    canvas = FigureCanvasAgg(figure)
    titles = [axes.title.get_window_extent(canvas.get_renderer()) for axes in figure.axes]
    others = titles + [axes.get_window_extent() for axes in figure.axes]
    assert all(figure.bbox.containsx(corner) for box in titles for corner in (box.x0, box.x1))
    assert all(figure.bbox.containsy(corner) for box in titles for corner in (box.y0, box.y1))
    assert not any(one.overlaps(other) for one in titles for other in others if one is not other)
    assert [axes.get_title().replace("\n", "").replace(" ", "") for axes in figure.axes] == [
        name.replace(" ", "") for name in 2 * names
    ]


@pytest.mark.parametrize("width", [2.5, 2.0, 1.5])
def test_an_equation_in_a_title_stays_on_one_line(width):
    panels = [Panel(title, frames(1, 2, channels=1), "black") for title in ("predictions after t = 30", "truth")]

    title = draw_panels(panels, width).axes[0].get_title()

    assert "\n" in title
    assert "t = 30" in title


@CHANNELS
def test_imagination_is_drawn(channels):
    truth = frames(2, 5, channels=channels)
    mask = torch.ones(2, 5, dtype=torch.bool)
    mask[1, 4] = False

    panels = draw_open_loop(truth, truth, mask, context=2, columns=4)
    futures = draw_futures(truth[0], truth[:, 2:], context=2, columns=3, colour=BLUE)

    after_the_end = np.asarray(panels.axes[3].images[0].get_array())[2 : 2 + HEIGHT, -2 - WIDTH : -2]
    np.testing.assert_array_equal(after_the_end, np.ones((HEIGHT, WIDTH, 3)))
    assert len(futures.axes) == 4


@CHANNELS
def test_an_episode_is_filmed_and_drawn_as_a_strip(channels):
    observation = (255 * frames(4, channels=channels)).to(torch.uint8).numpy()

    film = Image.open(io.BytesIO(gif([observation])))
    strip = draw_strips([("episode", SimpleNamespace(observation=observation, reward=np.zeros(4)))])

    assert film.size == (26 * WIDTH, 26 * HEIGHT)
    assert np.asarray(strip.axes[0].images[0].get_array()).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("shape", [(5, 8, 8), (0, 8, 8), (7,), (8, 8)])
def test_what_is_no_picture_is_refused_in_one_sentence(shape):
    with pytest.raises(ForbesError, match=r"run: the observations are .*, expected images of 1 to 4 channels\. Do so"):
        require_images("run", shape, "Do so")
