"""Compare completions of several runs on the same digits: scores, paired differences, record and tables."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from forbes.data import SequenceData, Split
from forbes.data.strokes.classifiers import DigitClassifiers, calibration_error
from forbes.evaluation.digits.completions import (
    Prefixes,
    model_scorer,
    neighbour_scorer,
    ngram_scorer,
    summarise,
    summarise_classes,
    truth_scorer,
)
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.ngram import ORDERS
from forbes.evaluation.runs import TrainedRun
from forbes.evaluation.scoring import Scorer, score_split, with_progress

__all__ = ["Row", "Study", "entries", "study"]


class Row(NamedTuple):
    """Scores of one kind of completions. The reference completes nothing and has the scores of the class only."""

    name: str
    path: str | None
    """Run folder; None if there is no model."""
    scores: Mapping[str, Tensor]
    """Score of each digit, `(B,)`, by score and step, e.g. `js[end]`."""
    calibration: float
    """ECE of the class over all digits."""
    classes: Tensor
    """Class distribution of each digit, `(B, 10)`."""
    best: Sequence[float] = ()
    """Expected error of the best of n completions, n = 1 … N, mean over digits."""
    average: Sequence[float] = ()
    """Expected error of the average image of n completions, n = 1 … N, mean over digits."""


class Study(NamedTuple):
    """All rows for one length of the prefix."""

    prefixes: Prefixes
    samples: int
    """Number of completions, N."""
    reference: Row
    """Scores of the prefix classifier."""
    runs: list[Row]
    ngram: Row
    """Scores of completions by n-grams of pen moves. A model below them does not draw better than without images."""
    similar: Row
    """Scores of the training digits with the most similar beginnings, as completions."""
    truth: Row
    """Scores of the true digits, as completions."""

    @property
    def completed(self) -> list[Row]:
        """All rows but the reference."""
        return [*self.runs, self.ngram, self.similar, self.truth]

    @property
    def differences(self) -> list[tuple[Row, Row, dict[str, Estimate]]]:
        """Mean difference of the first run minus each other run, paired over digits."""
        first = self.runs[0]
        return [
            (first, other, {name: Estimate.of(values - other.scores[name]) for name, values in first.scores.items()})
            for other in self.runs[1:]
        ]


def study(
    runs: Mapping[str, TrainedRun],
    data: SequenceData,
    classifiers: DigitClassifiers,
    prefixes: Prefixes,
    split: Split,
    samples: int,
    seed: int,
) -> Study:
    """Complete the same prefixes with every run, and score the completions.

    Args:
        runs: runs by title.
        data: their data, of the shortest length that one of them was trained with.
        classifiers: classifiers of these data.
        prefixes: prefixes to complete.
        split: split of the digits.
        samples: number of completions per digit, N.
        seed: random seed for the noise, the same for every run.
    """
    first = next(iter(runs.values()))
    length, context = data.length, prefixes.context

    def measure(name: str, path: str | None, run: TrainedRun, score: Scorer) -> Row:
        where = f"{name}, {split} digits sorted by length"
        batches = with_progress(prefixes.batches(data, split), f"{name}, {context} steps seen", len(prefixes.digits))
        readings = score_split(run.model, batches, score, seed, where).values
        classes, scores = readings["classes"], summarise(readings, prefixes, length)
        curves = (readings[curve].mean(0).tolist() for curve in ("best", "average"))
        return Row(name, path, scores, calibration_error(classes, prefixes.labels), classes, *curves)

    classes = prefixes.reference
    error = calibration_error(classes, prefixes.labels)
    scorer = model_scorer(data, context, samples, classifiers)
    return Study(
        prefixes,
        samples,
        Row("reference", None, summarise_classes(classes, prefixes), error, classes),
        [measure(name, run.path, run, scorer) for name, run in runs.items()],
        measure(f"{max(ORDERS)}-gram", None, first, ngram_scorer(data, context, samples, classifiers)),
        measure("similar digits", None, first, neighbour_scorer(data, context, samples, classifiers)),
        measure("true digits", None, first, truth_scorer(data, context, classifiers)),
    )


def entries(study: Study, digits: str) -> list[dict[str, Any]]:
    """Return all scores and differences by full name, as entries for `completions.json`.

    Args:
        study: results for one length of the prefix.
        digits: name of the digits, e.g. `test[:300]`.
    """
    context = study.prefixes.context

    def name(score: str) -> str:
        return f"{digits}/" + score.replace("[", f"[c={context},N={study.samples},")

    found: list[dict[str, Any]] = []
    for row in (*study.completed, study.reference):
        head: dict[str, Any] = {"row": row.name, "run": row.path, "minus": None}
        found += [head | {"metric": name(score), **_entry(Estimate.of(each))} for score, each in row.scores.items()]
        found.append(head | {"metric": name("ece[end]"), "mean": row.calibration, "standard_error": None})
    for one, other, scores in study.differences:
        head = {"row": one.name, "run": one.path, "minus": other.path}
        found += [head | {"metric": name(score), **_entry(each)} for score, each in scores.items()]
    return [entry | {"digits": len(study.prefixes.digits)} for entry in found]


def _entry(estimate: Estimate) -> dict[str, float | None]:
    """Return an estimate for JSON, with None for NaN."""
    return {key: value if math.isfinite(value) else None for key, value in estimate._asdict().items()}
