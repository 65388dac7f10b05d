"""Does a trajectory keep its mode? Roll-outs of one belief over time (the paper's appendix on SimCore).

The appendix argues that a belief that is a vector (SimCore, our `VectorModel`) draws the digit anew at every step, but
a distribution over states draws it once, with the first state. So several roll-outs of one belief are followed through
time, each with the digit that a classifier reads in it. The number is how many end as another digit than they began.
"""

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from forbes.data import Strokes
from forbes.data.strokes.classifiers import DigitClassifiers, load_classifiers
from forbes.errors import ForbesError
from forbes.evaluation.digits.completions import Prefixes, classes_at, model_scorer, select_prefixes, summarise
from forbes.evaluation.digits.scores import entropy
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.predictions import complete
from forbes.evaluation.runs import TrainedRun, load_runs
from forbes.evaluation.scoring import score_split, with_progress
from forbes.figures.families import group, require_same_data
from forbes.figures.grids import Panel, draw_bands, seen_panel
from forbes.seeding import forked

__all__ = ["count_changes", "draw_simcore", "read_digits"]

_DIGITS = 100
"""Test digits on which changes are counted; the most ambiguous of them is drawn."""
_COUNTED = 20
"""Roll-outs of each digit on which changes are counted."""
_EARLY = 60  # percent of the remaining steps: one of those in `forbes.evaluation.digits.completions`
_COLUMNS = 8
_CLEAR = 0.9
"""Probability above which a digit is shown."""


def draw_simcore(runs: Sequence[str], samples: int = 4, context: int = 15) -> dict[str, Figure]:
    """Draw roll-outs from one belief of each model, and print how many change their digit.

    The digit is the most ambiguous of the first test digits by its beginning, which no model decides. Each frame has
    the class of its drawing so far, if the classifier is sure of one. Of runs that differ only in the seed, the first
    is drawn.

    Args:
        runs: run folders of digit strokes, e.g. of a `VectorModel` and of FORBES.
        samples: number of roll-outs drawn.
        context: number of frames that the models see.

    Raises:
        ForbesError: if the data are no strokes, or the runs are of different data.
    """
    trained = load_runs(runs)
    for run in trained:
        if not isinstance(run.data.source, Strokes):
            raise ForbesError(f"{run.path}: its data are {run.data.source}, expected Strokes. Name runs of strokes")
    require_same_data(trained)
    data = trained[0].data
    assert isinstance(data.source, Strokes)
    if not context < data.length:
        raise ForbesError(f"--context {context}: expected less than the length of the sequences, {data.length}")
    classifiers = load_classifiers(data.source.origin)
    prefixes = select_prefixes(data, "test", _DIGITS, context, classifiers.prefix)
    place = int(entropy(prefixes.reference).argmax())
    bands = []
    for family in group(trained):
        shown, changed = count_changes(family.runs[0], prefixes, classifiers)
        print(f"{family.name}: {shown} % of roll-outs show a digit at {_EARLY} % of their way, {changed} % change it")
        title = (
            f"{family.name}: {shown.mean:.0f} % of roll-outs show a digit early, {_share(changed)} of these change it"
        )
        bands.append(_band(family.runs[0], family.style.colour, title, prefixes, place, samples, classifiers))
    figure = draw_bands([panels for panels, _ in bands])
    for axes, (_, digits) in zip(figure.axes[1::2], bands, strict=True):
        _write(axes, digits)
    return {"simcore": figure}


def _share(percentage: Estimate) -> str:
    return f"{percentage.mean:.1f} ± {percentage.standard_error:.1f} %"


def count_changes(
    run: TrainedRun, prefixes: Prefixes, classifiers: DigitClassifiers, seed: int = 0
) -> tuple[Estimate, Estimate]:
    """Return the percentage of roll-outs that show a clear digit early, and of these, of those that end as another.

    Early is after 60 % of the steps that follow the prefix.
    """
    scorer = model_scorer(run.data, prefixes.context, _COUNTED, classifiers)
    batches = with_progress(prefixes.batches(run.data, "test"), f"{run.path} roll-outs", len(prefixes.digits))
    readings = score_split(run.model, batches, scorer, seed, f"{run.path}, test digits by length").values
    kept = summarise(readings, prefixes, run.data.length)[f"kept[{_EARLY}%]"]  # (B,)
    return Estimate.of(100 * readings[f"early {_EARLY}"][:, 0]), Estimate.of(100 * (1 - kept))


def _band(
    run: TrainedRun,
    colour: str,
    title: str,
    prefixes: Prefixes,
    place: int,
    samples: int,
    classifiers: DigitClassifiers,
) -> tuple[list[Panel], list[list[int | None]]]:
    """Return the panels of a model, and the digit of each frame of its roll-outs."""
    end, context = int(prefixes.steps[place]), prefixes.context
    batch = run.data.sequences("test", prefixes.digits[[place]], end)
    with forked("cpu", 0):
        frames = complete(run.model, run.data.source, batch, context, samples).frames  # (N, 1, T - c, 1, H, W)
    pictures = run.data.source.pictures(batch.observation)  # (1, T, 1, H, W)
    times = torch.linspace(context + 1, end, min(_COLUMNS, end - context)).round().long().tolist()
    digits = read_digits(frames, pictures, context, times, classifiers)
    seen = seen_panel(pictures.expand(samples, *pictures.shape[1:]), context)
    rolled = frames[:, 0, [time - context - 1 for time in times]]  # (N, K, 1, H, W)
    return [seen, Panel(title, rolled, colour, [f"t={time}" for time in times])], digits


def read_digits(
    frames: Tensor, pictures: Tensor, context: int, times: Sequence[int], classifiers: DigitClassifiers
) -> list[list[int | None]]:
    """Return the digit that each roll-out shows at each time, None where the classifier is not sure.

    Args:
        frames: roll-outs of one digit, `(N, 1, T - c, 1, H, W)`.
        pictures: the true digit, of which the first `context` frames are used, `(1, T, 1, H, W)`.
        context: number of frames before the roll-outs, c.
        times: steps to read, counted from 1.
        classifiers: classifiers of the digits.
    """
    columns = []
    for time in times:
        classes = classes_at(frames, pictures, context, torch.tensor([time]), classifiers.prefix)[:, 0]  # (N, 10)
        columns.append([int(row.argmax()) if row.max() > _CLEAR else None for row in classes])
    return [list(row) for row in zip(*columns, strict=True)]


def _write(axes: Axes, digits: Sequence[Sequence[int | None]]) -> None:
    """Write the digit of each frame in its corner."""
    columns, rows = len(digits[0]), len(digits)
    for row, of_row in enumerate(digits):
        for column, digit in enumerate(of_row):
            at = ((column + 0.08) / columns, 1 - (row + 0.08) / rows)
            text = "" if digit is None else str(digit)
            axes.text(*at, text, transform=axes.transAxes, fontsize=6, ha="left", va="top")
