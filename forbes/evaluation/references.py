r"""Reference scores that a model should exceed: log p of the same sequences under models without a belief.

For digit strokes, n-grams of pen moves (`forbes.evaluation.ngram`). For images with a Gaussian likelihood, two constant
predictions with the model's own standard deviation: the previous frame, and the mean frame of the training split,

.. math:: \log p(o_{1:T}) = \sum_t \log N(o_t;\, o_{t-1}, \sigma^2), \qquad \sum_t \log N(o_t;\, \bar o, \sigma^2),

where :math:`o_0 = \bar o`. A model below them predicts worse than if nothing moved. Of several parts, each is predicted
so, if all have a Gaussian likelihood.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from forbes.data import SequenceDataModule, Split, Strokes
from forbes.evaluation.ngram import fit_ngrams
from forbes.models import Likelihood, Normal, PartsLikelihood, SymlogNormal, VectorNormal
from forbes.seeding import forked

__all__ = ["lowest_above", "reference_means", "references"]

_EXAMPLES, _ROWS = 500, 50
"""Number of training sequences in the mean frame, and number of sequences decoded at a time."""


def references(data: SequenceDataModule, likelihood: Likelihood, split: Split, count: int) -> dict[str, Tensor]:
    """Return log p of each step of the first `count` sequences in nats, float64 `(N, T)`, by name; 0 on padding."""
    if isinstance(data.source, Strokes):
        ngrams = fit_ngrams(data.source, data.length)
        return {f"{order}-gram": values for order, values in ngrams.log_prob(split, count).items()}
    if _is_gaussian(likelihood):
        with forked("cpu", 0):  # for the dequantisation noise of coarse pixels
            return _still_pictures(data, likelihood, split, count)
    return {}


def reference_means(data: SequenceDataModule, likelihood: Likelihood, split: Split, count: int) -> dict[str, float]:
    """Return the mean of log p over the first `count` sequences, in nats per sequence, by name; empty if count is 0."""
    found = references(data, likelihood, split, count) if count else {}
    return {name: values.sum(1).mean().item() for name, values in found.items()}


def lowest_above(score: float, means: Mapping[str, float]) -> str | None:
    """Return the name of the lowest reference above a score, or None if there is none above it."""
    above = [(mean, name) for name, mean in means.items() if mean > score]
    return min(above)[1] if above else None


def _is_gaussian(likelihood: Likelihood) -> bool:
    """Return whether a target is a prediction of itself: of images, or of several parts with vectors among them."""
    if isinstance(likelihood, PartsLikelihood):
        return all(isinstance(part, Normal | VectorNormal | SymlogNormal) for part in likelihood.parts.values())
    return isinstance(likelihood, Normal)


@torch.no_grad()
def _still_pictures(data: SequenceDataModule, likelihood: Likelihood, split: Split, count: int) -> dict[str, Tensor]:
    total, steps = torch.zeros((), dtype=torch.float64), 0
    for index in torch.arange(min(_EXAMPLES, data.source.size("train"))).split(_ROWS):
        batch = data.sequences("train", index)
        total = total + likelihood.target(batch.observation)[batch.mask].sum(0)  # (*O)
        steps += int(batch.mask.sum())
    mean = (total / max(steps, 1)).float()  # (*O)
    found: dict[str, list[Tensor]] = {"mean frame": [], "last frame": []}
    for index in torch.arange(count).split(_ROWS):
        batch = data.sequences(split, index)
        target = likelihood.target(batch.observation)  # (B, T, *O)
        before = torch.cat((mean.expand_as(target[:, :1]), target[:, :-1]), 1)  # (B, T, *O)
        for name, picture in (("mean frame", mean.expand_as(target)), ("last frame", before)):
            found[name].append(likelihood.log_prob(picture, target).double() * batch.mask)
    return {name: torch.cat(parts) for name, parts in found.items()}  # (N, T)
