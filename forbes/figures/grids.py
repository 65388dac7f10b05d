"""Grids of frames: truth, observed frames and predictions (paper, Figure 4)."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colors, rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from numpy.typing import NDArray
from torch import Tensor

from forbes.errors import ForbesError
from forbes.figures.episodes import MAX_CHANNELS, to_rgb
from forbes.figures.style import BLACK, GREY, PAGE, paper_style
from forbes.rounding import ceil_div
from forbes.shapes import Shape

__all__ = [
    "Bars",
    "Panel",
    "draw_bands",
    "draw_panels",
    "is_image",
    "require_images",
    "require_only_images",
    "seen_panel",
    "seen_steps",
    "truth_panel",
]

_GAP = 2  # pixels between the frames of a panel
_GAP_COLOUR = 0.86
_BARS_COLUMNS = 3
"""Width of a row of bars, in frames."""


class Panel(NamedTuple):
    """Frames side by side under one title."""

    title: str
    images: Tensor
    """Values in [0, 1] for R rows and K columns, `(R, K, C, H, W)`, drawn by `to_rgb`."""
    colour: str
    """Colour of the ink of grey frames."""
    labels: Sequence[str] = ()
    """Labels below the columns."""
    names: Sequence[str] = ()
    """Labels on the left of the rows; in every band, or in none."""


class Bars(NamedTuple):
    """Probabilities as bars, one row for each row of frames."""

    title: str
    shares: NDArray[np.float64]
    """Probabilities of V values in R rows, `(R, V)`."""
    colour: str
    behind: NDArray[np.float64] | None = None
    """Probabilities to compare with, `(R, V)`, drawn as a grey area."""
    notes: Sequence[str] = ()
    """Notes above the bars of each row."""


def truth_panel(observation: Tensor, times: Sequence[int]) -> Panel:
    """Return a panel of sequences `(B, T, C, H, W)` at some steps, counted from 1."""
    return Panel("truth", _frames(observation, times), BLACK, [f"t={time}" for time in times])


def seen_panel(observation: Tensor, context: int) -> Panel:
    """Return a panel of three of the frames that a model sees."""
    times = seen_steps(context)
    return Panel("seen", _frames(observation, times), GREY, [f"t={time}" for time in times])


def seen_steps(context: int) -> list[int]:
    """Return up to three steps of the context, counted from 1, evenly spaced to its last."""
    return sorted({ceil_div(context * part, 3) for part in (1, 2, 3)})


def is_image(shape: Shape) -> bool:
    """Return whether observations of this shape are images that `to_rgb` can convert, or have some among their parts.

    All images of several parts must be such.
    """
    if isinstance(shape, Mapping):
        images = [one for one in shape.values() if len(one) == 3]
        return len(images) > 0 and all(map(is_image, images))
    return len(shape) == 3 and 1 <= shape[0] <= MAX_CHANNELS


def require_images(where: str, shape: Shape, remedy: str) -> None:
    """Raise a ForbesError, with this remedy, unless observations of this shape are images that `to_rgb` can convert."""
    if is_image(shape):
        return
    if isinstance(shape, Mapping):
        found = f"of the parts {shape}"
    else:
        found = f"vectors of {shape[0]}" if len(shape) == 1 else f"of shape {tuple(shape)}"
    raise ForbesError(
        f"{where}: the observations are {found}, expected images of 1 to {MAX_CHANNELS} channels. {remedy}"
    )


def require_only_images(where: str, shape: Shape, remedy: str) -> None:
    """Raise a ForbesError as `require_images`, and if observations have several parts."""
    if isinstance(shape, Mapping):
        parts = ", ".join(shape)
        raise ForbesError(f"{where}: the observations have the parts {parts}, expected images alone. {remedy}")
    require_images(where, shape, remedy)


def _frames(observation: Tensor, times: Sequence[int]) -> Tensor:
    """Return K steps, counted from 1: `(B, T, C, H, W)` to `(B, K, C, H, W)`."""
    return observation.float()[:, [time - 1 for time in times]]


def draw_panels(panels: Sequence[Panel | Bars], width: float = PAGE) -> Figure:
    """Draw panels with the same number of rows next to each other. The first has frames; all frames have one size."""
    return draw_bands([panels], width)


def draw_bands(bands: Sequence[Sequence[Panel | Bars]], width: float = PAGE) -> Figure:
    """Draw bands of panels below each other.

    The panels of a band have the same number of rows, and all bands the same columns; the last band may have fewer
    panels.
    """
    first = [_first(band) for band in bands]
    height, wide = first[0].images.shape[3:]
    margin, line, labels, between = 0.03, 0.13, 0.18, 0.07  # inches: left and right, of a title, below, under a band
    below = [labels if any(_is_labelled(panel) for panel in band) else between for band in bands]  # inches
    names = 0.5 if first[0].names else 0.0  # inches, at the left
    space = 0.7  # between panels, in frames
    columns = [panel.images.shape[1] if isinstance(panel, Panel) else _BARS_COLUMNS for panel in bands[0]]
    cell = (width - 2 * margin - names) / (sum(columns) + space * (len(columns) - 1))  # inches
    rooms = [count * cell + 2 * margin for count in columns]  # inches, of the titles
    talls = [panel.images.shape[0] * cell * height / wide for panel in first]  # inches
    with paper_style():
        titles = [[_wrapped(panel.title, room) for panel, room in zip(band, rooms, strict=False)] for band in bands]
        lines = [max(title.count("\n") + 1 if title else 0 for title in band) for band in titles]
        above = [line * count + 0.11 if count else 0.0 for count in lines]  # inches
        total = sum(above) + sum(talls) + sum(below)
        figure = Figure((width, total))
        bottom = total
        for band, of_band, tall, room, under in zip(bands, titles, talls, above, below, strict=True):
            bottom, left = bottom - room - tall, margin + names
            for panel, title, count in zip(band, of_band, columns[: len(band)], strict=True):
                axes = figure.add_axes((left / width, bottom / total, count * cell / width, tall / total))
                if isinstance(panel, Panel):
                    _draw_panel(axes, panel)
                else:
                    _draw_bars(axes, panel)
                axes.set_title(title, color=panel.colour, pad=4)
                left += (count + space) * cell
            bottom -= under
    return figure


def _wrapped(title: str, width: float) -> str:
    """Break a title into lines of at most `width` inches, after spaces and between the parts of a path.

    Equations such as `t = 30` stay on one line.
    """
    lines = [""]
    for part in re.findall(r"(?: = |[^ /_-])+[ /_-]*|[ /_-]+", title):
        longer = lines[-1] + part
        points = TextPath((0, 0), longer.rstrip(), rcParams["axes.titlesize"]).get_extents().width
        if lines[-1] and points > 72 * width:
            lines.append(part)
        else:
            lines[-1] = longer
    return "\n".join(line.rstrip() for line in lines)


def _is_labelled(panel: Panel | Bars) -> bool:
    return isinstance(panel, Bars) or bool(panel.labels)


def _first(band: Sequence[Panel | Bars]) -> Panel:
    """Return the first panel of a band, which has frames."""
    assert isinstance(band[0], Panel)
    return band[0]


def _draw_panel(axes: Axes, panel: Panel) -> None:
    width = panel.images.shape[-1] + _GAP
    axes.imshow(_mosaic(panel.images, panel.colour), aspect="auto")
    axes.set_xticks([width * k + width / 2 for k in range(len(panel.labels))], panel.labels, fontsize=6, color=GREY)
    axes.tick_params(length=0, pad=2)
    tall = panel.images.shape[-2] + _GAP
    axes.set_yticks([tall * r + tall / 2 for r in range(len(panel.names))], panel.names, fontsize=6, color=GREY)
    axes.grid(False)
    axes.spines[:].set_visible(False)


def _draw_bars(axes: Axes, bars: Bars) -> None:
    """Draw row r between the heights R - r - 1 and R - r, with space for the note above a probability of 1."""
    rows, values = bars.shares.shape
    edges, full = np.arange(values + 1) - 0.5, 0.62
    for row in range(rows):
        floor = rows - row - 1
        axes.axhline(floor, color=GREY, lw=0.4)
        if bars.behind is not None:
            axes.stairs(floor + full * bars.behind[row], edges, baseline=floor, fill=True, color=GREY, alpha=0.4, lw=0)
        axes.bar(np.arange(values), full * bars.shares[row], 0.6, bottom=floor, color=bars.colour)
    for row, note in enumerate(bars.notes):
        axes.text(values - 0.5, rows - row - 0.08, note, fontsize=5, color=GREY, ha="right", va="top")
    axes.set(xlim=(-0.6, values - 0.4), ylim=(0, rows), yticks=[])
    axes.set_xticks(range(values), [str(value) for value in range(values)], fontsize=5, color=GREY)
    axes.tick_params(length=0, pad=2)
    axes.grid(False)
    axes.spines[:].set_visible(False)


def _mosaic(images: Tensor, colour: str) -> NDArray[np.float32]:
    """Arrange frames, in ink on white: `(R, K, C, H, W)` to `(R (H + gap) + gap, K (W + gap) + gap, 3)`."""
    rows, columns, channels, height, width = images.shape
    values = images.detach().float().cpu().numpy()
    if channels == 1:
        ink = 1 - np.asarray(colors.to_rgb(colour), dtype=np.float32)
        frames = 1 - values.transpose(0, 3, 1, 4, 2) * ink  # (R, H, K, W, 3)
    else:
        frames = to_rgb(values).transpose(0, 3, 1, 4, 2)  # (R, H, K, W, 3)
    canvas = np.full((rows * (height + _GAP) + _GAP, columns * (width + _GAP) + _GAP, 3), _GAP_COLOUR, np.float32)
    for r in range(rows):
        for k in range(columns):
            y, x = r * (height + _GAP) + _GAP, k * (width + _GAP) + _GAP
            canvas[y : y + height, x : x + width] = frames[r, :, k]
    return canvas
