"""Figure 4 of the paper: completions of ambiguous beginnings, next to the truth."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from forbes.data import SequenceBatch, SequenceData, SequenceSource, Strokes
from forbes.errors import ForbesError
from forbes.evaluation.adapters import load_all
from forbes.evaluation.digits.neighbours import TrainingPrefixes, last_frame
from forbes.evaluation.predictions import complete, first_of_each_class, true_frames, whole_sequences
from forbes.figures.families import RunFamily, group, require_same_data
from forbes.figures.grids import Panel, draw_panels, require_only_images, seen_panel, truth_panel
from forbes.seeding import forked

__all__ = ["ambiguous_digits", "draw_predictions", "predictions"]

_SHOWN = 10
"""Number of sequences drawn of data without classes."""


def draw_predictions(
    runs: Sequence[str],
    index: Sequence[int] = (),
    samples: int = 6,
    mean: bool = False,
    context: int = 15,
    model: Sequence[Sequence[str]] = (),
    data: str | None = None,
) -> dict[str, Figure]:
    """Draw `predictions` at the last step of the data's length, and for digit strokes at the end of the longest shown.

    Args:
        runs: run folders of image data. Of runs that differ only in the seed, the first is drawn.
        index: test sequences to draw. Default: for digit strokes the most ambiguous of each class
            (`ambiguous_digits`), else the first of the split.
        samples: number of completions of each sequence, N.
        mean: for written strokes, draw pixel probabilities instead of samples.
        context: number of frames that the models see.
        model: models trained elsewhere, as in `load_all`.
        data: their data.

    Raises:
        ForbesError: if the observations are no images, the runs are of different data, or an argument does not fit
            the data.
    """
    trained = load_all(runs, model, data, needs=("sample", "mean"))
    for run in trained:
        require_only_images(run.path, run.data.observation_shape, "Name runs of images, e.g. of strokes")
        if mean and not run.data.source.increments:
            raise ForbesError(f"--mean: the frames of {run.path} are expectations anyway, not sampled. Leave it out")
    require_same_data(trained)
    shown = trained[0].data
    if not context < shown.length:
        raise ForbesError(f"--context {context}: expected less than the length of the sequences, {shown.length}")
    chosen = _chosen(shown, index, context)
    whole = isinstance(shown.source, Strokes)
    batch = whole_sequences(shown, "test", chosen) if whole else shown.sequences("test", chosen)
    families = group(trained)
    return {
        f"predictions-t{time}": predictions(families, shown.source, batch, time, context, samples, mean)
        for time in sorted({shown.length, batch.observation.shape[1]})
    }


def _chosen(data: SequenceData, index: Sequence[int], context: int) -> Tensor:
    """Return the test sequences to draw, by a rule that does not depend on any model."""
    size = data.source.size("test")
    for value in index:
        if not 0 <= value < size:
            raise ForbesError(f"--index {value}: the test split has {size} sequences, expected 0 to {size - 1}")
    if index:
        return torch.tensor(index)
    if isinstance(data.source, Strokes):
        return ambiguous_digits(data, context)
    return first_of_each_class(data, "test", _SHOWN)


def predictions(
    families: Sequence[RunFamily],
    source: SequenceSource,
    batch: SequenceBatch,
    time: int,
    context: int,
    samples: int,
    mean: bool = False,
    seed: int = 0,
) -> Figure:
    """Draw Figure 4: truth, some of the observed frames, and N sampled completions by each family.

    Args:
        families: families to draw, one group of columns each.
        source: source of the sequences.
        batch: sequences to draw, one row each, with at least `time` steps.
        time: step to show, counted from 1.
        context: number of steps that the models see.
        samples: number of completions, N.
        mean: for written strokes, show pixel probabilities instead of samples (`complete`).
        seed: random seed for the samples.
    """
    last = batch.observation.shape[1]
    pictures = true_frames(families[0].model, source, batch)
    panels = [truth_panel(pictures, sorted({time, last})[::-1]), seen_panel(pictures, context)]
    for family in families:
        with forked("cpu", seed):
            completions = complete(family.model, source, batch, context, samples, mean)
        frames = completions.at(time)  # (N, B, C, H, W)
        panels.append(Panel(f"{family.name}, t = {time}", frames.transpose(0, 1), family.style.colour))
    return draw_panels(panels)


def ambiguous_digits(data: SequenceData, context: int, candidates: int = 500, neighbours: int = 50) -> Tensor:
    """Return test digits with an ambiguous beginning, independent of any model: `(classes,)`, int64.

    For each class it is the digit, of those among the first `candidates` with more than `context` steps, whose nearest
    training digits, by the blurred frame t = `context`, have the highest entropy of labels.
    """
    source = data.source
    assert isinstance(source, Strokes)
    index = torch.nonzero(source.steps("test")[:candidates] > context)[:, 0]  # (N,)
    labels, test_labels = source.labels("train"), source.labels("test")[index]
    test = source.pictures(data.sequences("test", index, context).observation)  # (N, T, C, H, W)
    nearest = TrainingPrefixes(data, context, last_frame).nearest(test, neighbours)  # (N, neighbours)
    counts = torch.nn.functional.one_hot(labels[nearest], 10).sum(1).double()  # (N, 10)
    entropy = torch.special.entr(counts / counts.sum(1, keepdim=True)).sum(1)  # (N,)
    most = [
        torch.where(test_labels == label, entropy, -1).argsort(descending=True, stable=True)[0]
        for label in test_labels.unique()
    ]
    return index[torch.stack(most)]
