"""The paper's figures on digit strokes: predictions (Figure 4) and the ELBO against updates (Figure 5)."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

from forbes.data import SequenceBatch, SequenceDataModule, SequenceSource, Strokes
from forbes.evaluation.digits.neighbours import TrainingPrefixes, last_frame
from forbes.evaluation.predictions import complete
from forbes.figures.grids import Panel, draw_panels, seen_panel, truth_panel
from forbes.figures.style import COLUMN, draw_range, draw_references, paper_style, show_settled
from forbes.models import BeliefModel
from forbes.seeding import forked

__all__ = ["FamilyCurves", "ambiguous_digits", "elbo_against_updates", "predictions"]


class FamilyCurves(NamedTuple):
    """Runs of one configuration, with different seeds."""

    name: str
    colour: str
    model: BeliefModel
    """Model of the first run."""
    curves: Sequence[pd.Series]
    """Training bound on the validation split against updates, one curve per run."""
    tests: Sequence[float]
    """Test ELBO of each evaluated run, if the ELBO is the training bound."""


def predictions(
    families: Sequence[FamilyCurves],
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
        source: source of the digits.
        batch: digits to draw, one row each, with at least `time` steps.
        time: step to show, counted from 1.
        context: number of steps that the models see.
        samples: number of completions, N.
        mean: for written strokes, show pixel probabilities instead of samples (`complete`).
        seed: random seed for the samples.
    """
    last = batch.observation.shape[1]
    pictures = source.pictures(batch.observation)
    panels = [truth_panel(pictures, sorted({time, last})[::-1]), seen_panel(pictures, context)]
    for family in families:
        with forked("cpu", seed):
            completions = complete(family.model, source, batch, context, samples, mean)
        frames = completions.at(time)  # (N, B, C, H, W)
        panels.append(Panel(f"{family.name}, t = {time}", frames.transpose(0, 1), family.colour))
    return draw_panels(panels)


def elbo_against_updates(families: Sequence[FamilyCurves], references: Mapping[str, float]) -> Figure:
    """Draw Figure 5: validation ELBO against updates, mean and range over runs; a diamond is the final test ELBO.

    A family trained with another bound is drawn with that bound, and the legend then names all bounds. Dotted lines are
    the `references` on the validation split, by name.
    """
    bounds = [family.model.bound_name for family in families]
    with paper_style():
        figure = Figure((COLUMN, 2.3), layout="constrained")
        axes = figure.subplots()
        for family, bound in zip(families, bounds, strict=True):
            table = pd.concat(family.curves, axis=1).dropna()  # updates common to all runs
            runs = len(family.curves)
            label = family.name if runs == 1 else f"{family.name}, {runs} runs"
            label += f", {bound}" if len(set(bounds)) > 1 else ""
            draw_range(axes, table, family.colour, label)
            if family.tests:
                test = sum(family.tests) / len(family.tests)
                (end,) = axes.plot(table.index.max(), test, "D", color=family.colour, markersize=5, zorder=3)
                end.set(markeredgecolor="white", clip_on=False)
        if any(family.tests for family in families):
            axes.plot([], [], "D", color="none", markeredgecolor="black", markersize=4, label="final test")
        show_settled(axes, [curve for family in families for curve in family.curves])
        draw_references(axes, references)
        title = bounds[0].replace("elbo", "ELBO") if len(set(bounds)) == 1 else "bound"
        axes.set(xlabel="updates", ylabel=f"validation {title}\nnats per sequence")
        axes.legend(loc="lower right")
    return figure


def ambiguous_digits(data: SequenceDataModule, context: int, candidates: int = 500, neighbours: int = 50) -> Tensor:
    """Return test digits with an ambiguous beginning, independent of any model: `(classes,)`, int64.

    For each class it is the digit among the first `candidates` whose nearest training digits, by the blurred frame
    t = `context`, have the highest entropy of labels.
    """
    source = data.source
    assert isinstance(source, Strokes)
    labels, test_labels = source.labels("train"), source.labels("test")[:candidates]
    index = torch.arange(len(test_labels))
    test = source.pictures(data.sequences("test", index, context).observation)  # (N, T, C, H, W)
    nearest = TrainingPrefixes(data, context, last_frame).nearest(test, neighbours)  # (N, neighbours)
    counts = torch.nn.functional.one_hot(labels[nearest], 10).sum(1).double()  # (N, 10)
    entropy = torch.special.entr(counts / counts.sum(1, keepdim=True)).sum(1)  # (N,)
    return torch.stack(
        [
            torch.where(test_labels == label, entropy, -1).argsort(descending=True, stable=True)[0]
            for label in test_labels.unique()
        ]
    )
