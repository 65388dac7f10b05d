"""The common style of all figures: sizes for a two-column paper, few colours, no pyplot state."""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from forbes.errors import ForbesError
from forbes.files import replace_file

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["BLACK", "BLUE", "COLUMN", "GREEN", "GREY", "METHODS", "ORANGE", "PAGE", "PALETTE", "Method"]
__all__ += ["density_map", "draw_range", "draw_references", "method_styles", "method_title", "paper_style"]
__all__ += ["save_figure", "save_png_and_pdf", "show_settled", "task_title"]

COLUMN, PAGE = 3.3, 6.9
"""Widths in inches: one column and the whole page."""

BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#007a5a"
BLACK, GREY = "#1a1a1a", "#808080"


class Method(NamedTuple):
    """How a method is drawn in every figure. Line and marker differ too, for colour-blind readers and grey print."""

    colour: str
    line: Any = "-"
    """Line style: a name, or an offset with the lengths of dashes and gaps in multiples of the line's width."""
    marker: str = "o"


METHODS = {
    "FORBES": Method(BLUE),
    "RSSM": Method(ORANGE, (0, (5, 1.5)), "s"),
    "RSSM wide": Method("#e69f00", (0, (5, 1.5, 1, 1.5)), "D"),
    "Mixture": Method(GREEN, (0, (2, 1)), "^"),
    "Categorical": Method("#cc79a7", (0, (5, 1.5, 1, 1.5, 1, 1.5)), "v"),
    "Particle": Method("#56b4e9", (0, (8, 1.5)), "P"),
    "Vector": Method("#7d4f1f", (0, (3, 3)), "X"),
    "PlaNet": Method("#882255", (0, (1, 1)), "<"),
    "Dreamer": Method(ORANGE, (0, (5, 1.5)), "s"),  # the agent on the RSSM, and drawn like it
    "DreamerV3": Method("#cc79a7", (0, (5, 1.5, 1, 1.5, 1, 1.5)), "v"),  # on categorical states, and drawn like them
    "exact belief": Method(BLACK, "-", "*"),
}
"""Spelling and style of each method. The colours differ in hue and brightness (after Okabe and Ito)."""

PALETTE = (BLUE, ORANGE, GREEN, BLACK, "#cc79a7", "#56b4e9", "#e69f00", GREY)
"""Colours of things that are no methods, in order."""

_SPARE = tuple(dict.fromkeys(style for name, style in METHODS.items() if name != "exact belief"))
"""Styles of unknown methods, in order."""

_STYLE: dict[Any, Any] = {
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 8,
    "figure.dpi": 200,
    "figure.titlesize": 8,
    "font.family": "DejaVu Sans",  # bundled with matplotlib, so that figures are the same on every machine
    "font.size": 8,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "image.interpolation": "nearest",
    "legend.fontsize": 7,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "pdf.fonttype": 42,  # TrueType, so that text can be selected
    "savefig.dpi": 200,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
}


def method_title(name: str) -> str:
    """Return the title of a method, spelled as in `METHODS`: `rssm_wide` is RSSM wide, and `forbes_deep` FORBES deep.

    Args:
        name: title, or name of a configuration or run folder. An unknown name is its own title.
    """
    if (method := _method(name)) is None:
        return name
    plain = _plain(name)
    return (method + plain[_matched(method, plain) :]).strip()


def task_title(task: str) -> str:
    """Return the title of a task, which is its last part: `gymnasium:popgym:popgym-X-v0` is popgym-X-v0."""
    return task.rpartition(":")[2]


def method_styles(names: Sequence[str]) -> dict[str, Method]:
    """Return the style of each method in a figure.

    The first name of a method in `METHODS` has its style, e.g. `FORBES (deep)` that of FORBES. Further names of the
    same method, and unknown ones, take the styles that no other name has, in order.

    Args:
        names: titles, or names of configurations or run folders, as in `method_title`.
    """
    styles: dict[str, Method] = {}
    for name in names:
        method = _method(name)
        if method is not None and METHODS[method] not in styles.values():
            styles[name] = METHODS[method]
    spare = cycle([style for style in _SPARE if style not in styles.values()] or _SPARE)
    return {name: styles.get(name) or next(spare) for name in names}


def _method(name: str) -> str | None:
    """Return the method that a name begins with, the longest if there are several."""
    found = [method for method in METHODS if _matched(method, _plain(name))]
    return max(found, key=len, default=None)


def _matched(method: str, plain: str) -> int:
    """Return how many characters of a plain name are the method's, 0 if it is another's."""
    for spelling in (method, method.removesuffix(" belief")):  # the exact belief's agents are called exact
        if re.match(rf"{spelling}(?![a-z])", plain, re.IGNORECASE):
            return len(spelling)
    return 0


def _plain(name: str) -> str:
    """Return a name with spaces, without the prefix of the configurations of agents."""
    return name.replace("_", " ").removeprefix("agent ")


@contextmanager
def paper_style() -> Iterator[None]:
    """Use our style inside the `with` block."""
    with mpl.rc_context(_STYLE):
        yield


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure atomically, in the format of the path's suffix.

    Raises:
        ForbesError: if the suffix is not an image format.
    """
    content = io.BytesIO()
    # Without a date, the same figure has the same bytes.
    metadata = {"CreationDate": None} if path.suffix == ".pdf" else None
    try:
        with paper_style():
            figure.savefig(content, format=path.suffix[1:] or "png", metadata=metadata)
    except ValueError as error:
        raise ForbesError(f"{path}: is not the name of an image ({error}). End it in .png") from error
    replace_file(path, content.getvalue())


def save_png_and_pdf(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as `NAME.png` and `NAME.pdf` to a folder, and return both paths."""
    paths = [folder / f"{name}{suffix}" for suffix in (".png", ".pdf")]
    for path in paths:
        save_figure(figure, path)
    return paths


def density_map(colour: str) -> LinearSegmentedColormap:
    """Return a colour map from white to a colour."""
    return LinearSegmentedColormap.from_list("density", ["white", colour])


def draw_range(axes: Axes, runs: "pd.DataFrame", method: Method, label: str) -> None:
    """Draw mean and range of several runs, one column each, against the index."""
    axes.fill_between(runs.index, runs.min(axis=1), runs.max(axis=1), color=method.colour, alpha=0.2, lw=0)
    marker = method.marker if len(runs) == 1 else ""  # a line of one point would be invisible
    mean = runs.mean(axis=1)
    axes.plot(mean.index, mean, color=method.colour, ls=method.line, label=label, marker=marker, markersize=3)


def draw_references(axes: Axes, means: Mapping[str, float], along: Literal["x", "y"] = "y") -> bool:
    """Draw a dotted line at each mean on a score axis, and return whether there is one, or a label.

    The axis is extended to means that are outside it by less than its extent. The highest line is labelled, and the
    highest mean that is too far above for a line is written with an arrow. Along x the labels are in the lowest quarter
    of the axes.
    """
    low, high = axes.get_ylim() if along == "y" else axes.get_xlim()
    near = {name: mean for name, mean in means.items() if 2 * low - high < mean < 2 * high - low}
    above = {name: mean for name, mean in means.items() if mean >= 2 * high - low}
    for mean in near.values():
        (axes.axhline if along == "y" else axes.axvline)(mean, color=GREY, ls=":", lw=0.8)
    if near:
        low, high = min(low, *near.values()), max(high, *near.values())
        limits = low - 0.03 * (high - low), high + 0.08 * (high - low)  # with room for the label
        best = max(near, key=lambda name: near[name])
        if along == "y":
            axes.set_ylim(*limits)
            at_edge = axes.get_yaxis_transform()
            axes.text(0.01, near[best], best, transform=at_edge, fontsize=6, color=GREY, va="bottom")
        else:
            axes.set_xlim(*limits)
            at_edge = axes.get_xaxis_transform()
            axes.text(near[best], 0.03, best, transform=at_edge, fontsize=6, color=GREY, ha="left", rotation=90)
    if above:
        _name_above(axes, above, along)
    return bool(near or above)


def _name_above(axes: Axes, means: Mapping[str, float], along: Literal["x", "y"]) -> None:
    """Write the highest of the means that are above an axis, with an arrow."""
    best = max(means, key=lambda name: means[name])
    label = f"{best} {means[best]:.1f}".replace(" -", " −")
    if along == "y":
        axes.text(0.01, 0.99, f"↑ {label}", transform=axes.transAxes, fontsize=6, color=GREY, va="top")
    else:
        axes.text(0.99, 0.03, f"{label} →", transform=axes.transAxes, fontsize=6, color=GREY, ha="right")


def show_settled(axes: Axes, curves: "Sequence[pd.Series]") -> None:
    """Set the y limits of an axis of curves to the range after their first quarter, in which they change fast.

    Without curves, as of a training without validation and shorter than the first logged update, they stay.
    """
    if not curves:
        return
    first = 0.25 * max(curve.index.max() for curve in curves)
    settled = [value for curve in curves for value in curve[curve.index >= first]]
    margin = 0.05 * (max(settled) - min(settled)) + 1e-6
    axes.set_ylim(min(settled) - margin, max(settled) + margin)
