"""Figures of digit completions: drawings with their classes, scores, and the error of the best of n."""

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from torch import Tensor

from forbes.data import SequenceBatch, SequenceSource
from forbes.evaluation.digits.scores import entropy
from forbes.evaluation.digits.study import Row, Study
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.predictions import complete
from forbes.figures.grids import Bars, Panel, draw_bands
from forbes.figures.style import BLACK, GREY, PAGE, Method, method_styles, paper_style
from forbes.models import BeliefModel
from forbes.seeding import derive_seed, forked

__all__ = ["by_ambiguity", "draw_class_scores", "draw_completions", "draw_errors"]

_SHOWN = 5
"""Number of completions drawn per digit."""
_SIDE_BY_SIDE = 2
"""Number of models next to each other; further models are drawn below."""
_LEGEND = 5  # entries per line
_SCORES = {  # scores of the class, with the rows for comparison
    "js[end]": ("JS to the reference, nats", ("ngram", "similar")),
    "entropy[end]": ("entropy of the class, nats", ("ngram", "similar", "reference")),
    "nll[end]": ("−log p of the label, nats", ("ngram", "similar", "reference")),
    "clear[end]": ("fraction of clear digits", ("ngram", "similar", "truth")),
}
_BESIDE = {
    "ngram": Method(GREY, "-", "x"),
    "similar": Method(GREY, ":", "."),
    "reference": Method(GREY, "--", "."),
    "truth": Method(GREY, (0, (3, 1, 1, 1)), "."),  # "-." looks solid in a legend: the marker hides its dot
}


def by_ambiguity(reference: Tensor, count: int) -> Tensor:
    """Return digits evenly spaced in decreasing order of their entropy under the reference, `(B, 10)`.

    The choice does not depend on any model. The result is `(count,)`, int64, or fewer if there are fewer digits.
    """
    order = entropy(reference).argsort(descending=True, stable=True)  # (B,)
    return order[torch.linspace(0, len(order) - 1, min(count, len(order))).round().long()]


def draw_completions(
    study: Study,
    models: Sequence[BeliefModel],
    source: SequenceSource,
    batch: SequenceBatch,
    place: Tensor,
    seed: int,
) -> Figure:
    """Draw prefixes from the most to the least ambiguous, with completions and their class distribution.

    Two models are drawn next to each other, further ones below.

    Args:
        study: results for one length of the prefix.
        models: models of its runs.
        source: source of the digits.
        batch: digits to draw, up to the end of the longest.
        place: position of each digit among the prefixes of the study, `(R,)`.
        seed: random seed for the completions.
    """
    context, end = study.prefixes.context, study.prefixes.steps[place]  # (R,)
    digit = torch.arange(len(place))
    pictures = source.pictures(batch.observation)
    truth, seen = (pictures[digit, step - 1][:, None].float() for step in (end, torch.full_like(end, context)))
    reference = study.reference.classes[place].numpy()  # (R, 10)
    ambiguity = [f"H = {value:.2f}" for value in study.reference.scores["entropy[end]"][place].tolist()]
    prefix_panels: list[Panel | Bars] = [
        Panel("truth", truth, BLACK, ["end"]),
        Panel("seen", seen, GREY, [f"t={context}"]),
        Bars("reference", reference, GREY, notes=ambiguity),
    ]
    of_models: list[list[Panel | Bars]] = []
    for row, model, style in zip(study.runs, models, _styles(study), strict=True):
        with forked("cpu", derive_seed(seed, "drawings", context)):
            completions = complete(model, source, batch, context, _SHOWN)
        frames = completions.frames[:, digit, end - context - 1]  # (S, R, 1, H, W)
        notes = [f"JS = {value:.2f}" for value in row.scores["js[end]"][place].tolist()]
        classes = Bars("their classes", row.classes[place].numpy(), style.colour, reference, notes)
        of_models.append([Panel(row.name, frames.transpose(0, 1), style.colour), classes])
    pairs = [of_models[first : first + _SIDE_BY_SIDE] for first in range(0, len(of_models), _SIDE_BY_SIDE)]
    return draw_bands([[*prefix_panels, *chain(*pair)] for pair in pairs])


def draw_class_scores(studies: Sequence[Study]) -> Figure:
    """Draw scores of the class against the length of the prefix, with standard errors over digits."""
    with paper_style():
        figure = Figure((PAGE, 2.1), layout="constrained")
        panels = figure.subplots(1, len(_SCORES))
        labelled: dict[str, Any] = {}
        for axes, (score, (title, beside)) in zip(panels, _SCORES.items(), strict=True):
            for number, style in enumerate(_styles(studies[0])):
                _draw_line(axes, studies, [one.runs[number] for one in studies], score, style)
            for name in beside:
                rows = [getattr(one, name) for one in studies]
                _draw_line(axes, studies, rows, score, _BESIDE[name])
            axes.set(title=title, xlabel="steps seen", xticks=[one.prefixes.context for one in studies])
            axes.set_ylim(bottom=0)
            labelled |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
        columns = min(len(labelled), _LEGEND)
        figure.legend([*labelled.values()], [*labelled], loc="outside upper center", ncols=columns, handlelength=3)
    return figure


def _styles(study: Study) -> list[Method]:
    """Return the style of each run."""
    names = [row.name for row in study.runs]
    styles = method_styles(names)
    return [styles[name] for name in names]


def _draw_line(axes: Axes, studies: Sequence[Study], rows: Sequence[Row], score: str, style: Method) -> None:
    found = [Estimate.of(row.scores[score]) for row in rows]
    steps = [study.prefixes.context for study in studies]
    means, widths = ([getattr(one, name) for one in found] for name in ("mean", "standard_error"))
    axes.errorbar(
        steps,
        means,
        widths,
        color=style.colour,
        ls=style.line,
        marker=style.marker,
        label=rows[0].name,
        capsize=2,
        markersize=3,
    )


def draw_errors(studies: Sequence[Study]) -> Figure:
    """Draw the error of the best of n completions (solid) and of their average image (dashed) against n."""
    with paper_style():
        figure = Figure((PAGE, 2.3), layout="constrained")
        panels = figure.subplots(1, len(studies), squeeze=False, sharey=True)[0]
        for axes, study in zip(panels, studies, strict=True):
            rows = [*zip(study.runs, _styles(study), strict=True)]
            rows += [(study.ngram, _BESIDE["ngram"]), (study.similar, _BESIDE["similar"])]
            for row, style in rows:
                number = np.arange(1, len(row.best) + 1)
                marks = {"marker": style.marker, "markevery": (0.05, 0.2), "markersize": 3}  # dashes are averages
                axes.plot(number, row.best, color=style.colour, label=row.name, **marks)
                axes.plot(number, row.average, "--", color=style.colour, **marks)
            axes.set(title=f"{study.prefixes.context} steps seen", xlabel="completions, n", xscale="log")
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.set_ylim(bottom=0)
        panels[0].set_ylabel("squared error in pixels")
        lines = panels[0].get_legend_handles_labels()
        title = "best of n; dashed, average of n"
        figure.legend(*lines, loc="outside upper center", ncols=min(len(rows), _LEGEND), title=title, title_fontsize=7)
    return figure
