r"""Score completions of digits with classifiers: are they precise yet diverse, without mixing two modes in one?

A model sees the first c steps of a digit and completes it N times, :math:`x^k_{c+1:T}`, each on its own trajectory
(`complete`). Completions are classified at the step n at which the true digit ends: models are trained up to there and
learn no sign of the end, so later they would keep drawing. With the classifiers of `forbes.data.strokes.classifiers`:

.. math:: p(y \mid o_{1:c}) = \frac1N \sum_k p_{\text{finished}}(y \mid x^k_n)
          \qquad\text{against}\qquad r(y \mid o_{1:c}) = p_{\text{prefix}}(y \mid o_{1:c})

For written strokes a completion is a binary drawing, one pixel per step; for whole frames it is a grey image. The
classifiers read grey values as they are. Scores of observations sample binary pixels from them.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.data import SequenceBatch, SequenceData, Split, Strokes
from forbes.data.strokes.classifiers import DigitClassifier, DigitClassifiers
from forbes.data.strokes.source import StrokePoints
from forbes.errors import ForbesError
from forbes.evaluation.digits.neighbours import TrainingPrefixes, mean_frame
from forbes.evaluation.digits.scores import (
    average_of,
    best_of,
    crps,
    energy_score,
    entropy,
    grey_ink,
    jensen_shannon,
    ratio_values,
)
from forbes.evaluation.ngram import ORDERS, fit_ngrams
from forbes.evaluation.predictions import complete
from forbes.evaluation.scores import Increments
from forbes.evaluation.scoring import Scorer
from forbes.models import BeliefModel

__all__ = [
    "Prefixes",
    "classes_at",
    "model_scorer",
    "neighbour_scorer",
    "ngram_scorer",
    "score_completions",
    "select_prefixes",
    "summarise",
    "summarise_classes",
    "truth_scorer",
]

_SHARES = (60, 80)
"""Percentages of the remaining steps after which a completion's class is compared with its final class."""
_CLEAR = 0.9
"""Probability above which a digit is clear: 95 % of true digits are, and 11 % of equal blends of two classes
(`data/README.md`)."""
_MASS = 0.05
_ROWS = 2  # digits per batch: with a hundred completions each, batches of ten take a quarter more time per digit
_TRUTHS = 2  # copies of the truth in place of completions: the fewest for which the scores are defined
_READINGS = (
    *("classes", "clear", "grey", "energy trained", "crps trained", "energy end", "crps end", "best", "average"),
    *(f"{name} {share}" for share in _SHARES for name in ("early", "kept")),
)


class Prefixes(NamedTuple):
    """The first c steps of the digits that continue after c steps, sorted by length."""

    context: int
    """Number of steps of the prefix, c."""
    digits: Tensor
    """Index of each digit in its split, int64 (B,)."""
    steps: Tensor
    """Length of each digit, n, int64 (B,)."""
    labels: Tensor
    """Class of each digit, int64 (B,)."""
    reference: Tensor
    """Class probabilities given the prefix, r(y | o_1:c), float64 (B, 10)."""

    def batches(self, data: SequenceData, split: Split) -> Iterator[tuple[int, SequenceBatch]]:
        """Yield the whole digits in batches, with the position of the first. The state of a step is its points."""
        assert isinstance(data.source, Strokes)
        longest = int(self.steps.max())
        for rows in torch.arange(len(self.digits)).split(_ROWS):
            points = data.source.gather(split, self.digits[rows], longest).points  # (B, T * points_per_step, 2)
            state = points.reshape(len(rows), longest, -1).float()  # (B, T, 2 * points_per_step)
            mask = torch.arange(longest) < self.steps[rows, None]  # (B, T), also where the end is observed
            yield int(rows[0]), data.sequences(split, self.digits[rows], longest)._replace(state=state, mask=mask)


def select_prefixes(
    data: SequenceData, split: Split, digits: int, context: int, classifier: DigitClassifier
) -> Prefixes:
    """Return the prefixes of those of the first `digits` digits of a split that continue after `context` steps.

    Raises:
        ForbesError: if there are fewer than two.
    """
    assert isinstance(data.source, Strokes)
    steps = data.source.steps(split)[:digits]
    order = steps.argsort(stable=True)
    index = order[steps[order] > context]  # (B,)
    if len(index) < 2:
        raise ForbesError(
            f"--prefixes {context}: of {digits} digits {len(index)} continue after {context} steps, expected at least "
            "2. Choose a smaller prefix, or more digits"
        )
    observation = data.source.pictures(data.sequences(split, index, context).observation)
    reference = classifier(_history(last=observation[:, -1].float(), mean=mean_frame(observation))).double().exp()
    return Prefixes(context, index, steps[index], data.source.labels(split)[index], reference)


def _history(last: Tensor, mean: Tensor) -> Tensor:
    """Return the input of a prefix classifier: last and mean frame, each `(*, 1, H, W)`, as `(*, 2, H, W)`."""
    return torch.cat((last, mean), -3)


def model_scorer(data: SequenceData, context: int, samples: int, classifiers: DigitClassifiers) -> Scorer:
    """Return the scorer of a model's N completions.

    Args:
        data: data module of strokes, of the length that models were trained with.
        context: number of steps that the model sees, c.
        samples: number of completions, N, at least 2.
        classifiers: classifiers of the digits.
    """

    def function(model: BeliefModel, batch: SequenceBatch) -> Increments:
        batch = _to_the_end(batch)
        frames = complete(model, data.source, batch, context, samples).frames  # (N, B, T - c, 1, H, W)
        return score_completions(frames, _pictures(data, batch), context, data.length, classifiers)

    return Scorer(_READINGS, f"c={context},N={samples}", function, _ROWS)


def truth_scorer(data: SequenceData, context: int, classifiers: DigitClassifiers) -> Scorer:
    """Return the scorer of the true digits as completions, a bound for the scores of single completions."""

    def function(model: BeliefModel, batch: SequenceBatch) -> Increments:
        batch = _pictures(data, _to_the_end(batch))
        frames = batch.observation[:, context:].float().expand(_TRUTHS, -1, -1, -1, -1, -1)
        return score_completions(frames, batch, context, data.length, classifiers)

    return Scorer(_READINGS, f"c={context},N={_TRUTHS}", function, _ROWS)


def neighbour_scorer(data: SequenceData, context: int, samples: int, classifiers: DigitClassifiers) -> Scorer:
    """Return the scorer of the N training digits with the most similar beginnings as completions."""
    training = TrainingPrefixes(data, context, mean_frame)

    def function(model: BeliefModel, batch: SequenceBatch) -> Increments:
        batch = _pictures(data, _to_the_end(batch))
        nearest = training.nearest(batch.observation[:, :context], samples)  # (B, N)
        others = data.sequences("train", nearest.T.flatten(), batch.observation.shape[1]).observation
        frames = data.source.pictures(others)[:, context:].float().unflatten(0, (-1, len(nearest)))  # (N, B, T - c, …)
        return score_completions(frames, batch, context, data.length, classifiers)

    return Scorer(_READINGS, f"c={context},N={samples}", function, _ROWS)


def ngram_scorer(data: SequenceData, context: int, samples: int, classifiers: DigitClassifiers) -> Scorer:
    """Return the scorer of N completions by the n-gram of the highest order, a model that has not seen an image."""
    assert isinstance(data.source, Strokes)
    source, ngrams = data.source, fit_ngrams(data.source, data.length)

    def function(model: BeliefModel, batch: SequenceBatch) -> Increments:
        batch = _pictures(data, _to_the_end(batch))
        steps = batch.mask.shape[1]
        seen = batch.state[:, :context].to(torch.uint8).reshape(len(batch.mask), -1, 2)  # (B, P, 2)
        seen = seen.repeat(samples, 1, 1)  # (N B, P, 2)
        points = ngrams.complete(seen, (steps - context) * source.points_per_step, max(ORDERS))
        drawn = source.decode(StrokePoints(points, torch.full((len(points),), points.shape[1]))).observation
        frames = source.pictures(drawn)[:, context:].float().unflatten(0, (samples, -1))  # (N, B, T - c, 1, H, W)
        return score_completions(frames, batch, context, data.length, classifiers)

    return Scorer(_READINGS, f"c={context},N={samples}", function, _ROWS)


def _to_the_end(batch: SequenceBatch) -> SequenceBatch:
    """Cut a batch at the end of its longest digit."""
    longest = int(batch.mask.sum(1).max())
    return batch.first(longest)  # (B, longest, ...)


def _pictures(data: SequenceData, batch: SequenceBatch) -> SequenceBatch:
    """Replace observations by cumulative images."""
    return batch._replace(observation=data.source.pictures(batch.observation))


@torch.no_grad()
def score_completions(
    frames: Tensor, batch: SequenceBatch, context: int, length: int, classifiers: DigitClassifiers
) -> dict[str, Tensor]:
    """Score N completions of each of B digits.

    Args:
        frames: grey values of steps c + 1 … T, `(N, B, T - c, 1, H, W)`.
        batch: true digits as cumulative images, T steps.
        context: number of steps that the model saw, c.
        length: training length of the models. Pixels are also scored at this step, or at the end if that is earlier.
        classifiers: classifiers of the digits.

    Returns:
        Values per digit, in float64: `classes`, the distribution p, `(B, 10)`; the fraction of `clear` digits, and
        `grey`, `(B, 1)`; the fraction that is clear `early`, after part of the remaining steps, and of those that
        `kept` their class to the end, `(B, 1)`; `energy` and `crps`, `(B, 1)`; the curves `best` and `average`,
        `(B, N)`.
    """
    end = batch.mask.sum(1)  # (B,)
    means, truth = _pixels(frames, batch, context, end)  # (N, B, P), (B, P)
    classes = classifiers.finished(means.view(*means.shape[:2], *frames.shape[3:])).double().exp()  # (N, B, 10)
    values = {"clear": _is_clear(classes).mean(0), "grey": grey_ink(means).mean(0)}
    for share in _SHARES:
        step = context + (share * (end - context) / 100).ceil().long()  # (B,)
        before = classes_at(frames, batch.observation, context, step, classifiers.prefix)  # (N, B, 10)
        early, same = _is_clear(before), before.argmax(-1) == classes.argmax(-1)  # (N, B), (N, B)
        values |= {f"early {share}": early.mean(0), f"kept {share}": (early * same).mean(0)}
    for name, step in (("trained", end.clamp(max=length)), ("end", end)):
        grey, pixels = _pixels(frames, batch, context, step)  # (N, B, P), (B, P)
        values |= {f"energy {name}": energy_score(grey.bernoulli(), pixels), f"crps {name}": crps(grey, pixels)}
    errors = (means - truth).double().square().sum(-1)  # (N, B)
    curves = {"best": best_of(errors), "average": average_of(means, truth)}  # (B, N)
    return {"classes": classes.mean(0)} | {name: each[:, None] for name, each in values.items()} | curves


def _pixels(frames: Tensor, batch: SequenceBatch, context: int, step: Tensor) -> tuple[Tensor, Tensor]:
    """Return completions, `(N, B, P)`, and truth, `(B, P)`, at one step of each digit, counted from 1, `(B,)`."""
    digit = torch.arange(len(step))
    return frames[:, digit, step - context - 1].flatten(2), batch.observation[digit, step - 1].float().flatten(1)


def _is_clear(classes: Tensor) -> Tensor:
    return (classes.amax(-1) > _CLEAR).double()  # (N, B)


def classes_at(frames: Tensor, observation: Tensor, context: int, step: Tensor, classifier: DigitClassifier) -> Tensor:
    """Classify each completion up to one step of each digit, `(B,)`, as an unfinished digit: `(N, B, 10)`."""
    drawn = torch.arange(context + 1, context + 1 + frames.shape[2]) <= step[:, None]  # (B, T - c)
    rolled = drawn[:, None].to(frames.dtype) @ frames.flatten(3)  # (N, B, 1, P), the sum over the steps drawn
    total = rolled.view(*frames.shape[:2], *frames.shape[3:]) + observation[:, :context].sum(1)
    mean = total / step.view(-1, 1, 1, 1)  # (N, B, 1, H, W)
    last = frames[:, torch.arange(len(step)), step - context - 1]  # (N, B, 1, H, W)
    log_probs: Tensor = classifier(_history(last, mean))
    return log_probs.double().exp()


def summarise(readings: Increments, prefixes: Prefixes, length: int) -> dict[str, Tensor]:
    """Return the scores of each digit, `(B,)`, by name and step, from the output of `score_completions`.

    `clear[n<=length]` is the fraction of clear digits among those that end within the training length, or NaN.
    """
    clear, short = readings["clear"][:, 0], (prefixes.steps <= length).double()
    scores = summarise_classes(readings["classes"], prefixes) | {"clear[end]": clear}
    scores[f"clear[n<={length}]"] = ratio_values(clear * short, short)
    for share in _SHARES:
        kept, early = (readings[f"{name} {share}"][:, 0] for name in ("kept", "early"))
        scores[f"kept[{share}%]"] = ratio_values(kept, early)
    for score in ("energy", "crps"):
        scores[f"{score}[t<={length}]"] = readings[f"{score} trained"][:, 0]
        scores[f"{score}[end]"] = readings[f"{score} end"][:, 0]
    scores["grey[end]"] = readings["grey"][:, 0]
    best, average = readings["best"], readings["average"]  # (B, N)
    return scores | {"error[end]": best[:, 0], "best[end]": best[:, -1], "average[end]": average[:, -1]}


def summarise_classes(classes: Tensor, prefixes: Prefixes) -> dict[str, Tensor]:
    """Return the scores of a class distribution, `(B, 10)`, for each digit, `(B,)`."""
    of_label = classes.gather(1, prefixes.labels[:, None])[:, 0]  # (B,)
    return {
        "js[end]": jensen_shannon(classes, prefixes.reference),
        "entropy[end]": entropy(classes),
        "entropy_gap[end]": entropy(classes) - entropy(prefixes.reference),
        "nll[end]": -of_label.log(),
        "classes[end]": (classes > _MASS).double().sum(1),
    }
