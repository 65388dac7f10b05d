"""The paper's figures as one table, and the function that draws one of them from run folders.

Nothing heavy is imported before a figure is drawn, so that listing them is fast.
"""

import difflib
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from forbes.errors import ForbesError

__all__ = ["FIGURES", "CatalogueEntry", "draw", "find_figure"]


class CatalogueEntry(NamedTuple):
    """A figure that can be drawn from runs."""

    name: str
    number: str
    """Number in the paper, "appendix", or "ours" for a figure that the paper does not have."""
    shows: str
    runs: str
    """What runs it needs."""
    target: str
    """Function that draws it, as `module:function` in `forbes.figures`: run folders to `Figure`s by file name."""
    options: tuple[str, ...] = ()
    """Keyword arguments of the function, which are options in `forbes.commands.parsers.figures`."""


_Entry = CatalogueEntry
_CHOSEN = ("index", "samples", "mean", "context")
_FOREIGN = ("model", "data")
FIGURES = (
    _Entry(
        "beliefs", "1", "beliefs over time, next to the exact", "known processes", "beliefs:draw_beliefs", ("index",)
    ),
    _Entry(
        "predictions",
        "4",
        "completions next to the truth",
        "images",
        "predictions:draw_predictions",
        (*_CHOSEN, *_FOREIGN),
    ),
    _Entry("elbo", "5", "validation ELBO against updates", "world models", "elbo:draw_elbo"),
    _Entry("per-step", "ours", "ELBO and its parts at each step", "world models, evaluated", "scores:draw_per_step"),
    _Entry("prequential", "ours", "log p(o_t | past)", "world models, evaluated", "scores:draw_prequential"),
    _Entry("calibration", "ours", "ranks of states, coverage", "world models", "calibration:draw_calibration"),
    _Entry("returns", "6", "returns against env steps", "agents", "agents:draw_returns"),
    _Entry("returns-1m", "appendix", "up to a million env steps", "agents", "agents:draw_returns_1m"),
    _Entry("trajectories", "7", "Dreamer, N = 1, 4; FORBES", "agents", "agents:draw_trajectories"),
    _Entry("trajectories-n", "appendix", "FORBES with N = 1, 2 and 4", "agents", "agents:draw_trajectories_n"),
    _Entry("layers", "appendix", "Dreamer with more layers", "agents", "agents:draw_layers"),
    _Entry("dmc-elbo", "appendix", "ELBO of stored episodes", "episodes, or agents", "dmc_elbo:draw_dmc_elbo"),
    _Entry(
        *("reconstructions", "appendix", "ten frames, truth, models", "images"),
        *("reconstructions:draw_reconstructions", ("index", "context")),
    ),
    _Entry(
        *("simcore", "appendix", "do roll-outs keep a digit?", "strokes"),
        *("simcore:draw_simcore", ("samples", "context")),
    ),
)
"""The figures, in the order of the paper."""


def find_figure(name: str) -> CatalogueEntry:
    """Return a figure by its name or its number in the paper.

    Raises:
        ForbesError: if there is none. It names the nearest.
    """
    for figure in FIGURES:
        if name in (figure.name, figure.number) and name not in ("appendix", "ours"):
            return figure
    near = difflib.get_close_matches(name, [figure.name for figure in FIGURES], n=1)
    hint = f"Did you mean {near[0]}?" if near else f"There are {', '.join(figure.name for figure in FIGURES)}"
    raise ForbesError(f"{name}: no such figure. {hint}")


def draw(name: str, runs: Sequence[str], folder: Path, **options: Any) -> list[Path]:
    """Draw a figure from run folders, and return the paths of its PNG and PDF files in `folder`.

    Args:
        name: name of the figure, or its number in the paper.
        runs: run folders, written by `forbes fit`.
        folder: folder to write to. It is created if it is missing.
        options: arguments of the figure's own, e.g. `context` of the predictions.

    Raises:
        ForbesError: if there is no such figure, it has no such option, or it cannot be drawn from these runs.
    """
    figure = find_figure(name)
    for option in options:
        if option not in figure.options:
            having = [other.name for other in FIGURES if option in other.options]
            raise ForbesError(
                f"--{option}: is an option of {' and '.join(having) or 'no figure'}, not of {figure.name}. Leave it out"
            )
    from forbes.evaluation.runs import require_distinct  # imports torch

    require_distinct(runs)
    figures = _load(figure.target)(runs, **options)
    save = _load("style:save_png_and_pdf")
    return [path for file, picture in figures.items() for path in save(picture, folder, file)]


def _load(target: str) -> Any:
    """Import a function of this package, given as `module:function`."""
    module, function = target.split(":")
    return getattr(importlib.import_module(f"forbes.figures.{module}"), function)
