r"""Reference scores that a model should exceed: log p of the same sequences under models without a belief.

For digit strokes, n-grams of pen moves (`forbes.evaluation.ngram`), under a likelihood that is a probability of binary
pixels. `whole` and `written` frames are the same events, see `Strokes`, so the n-grams are references for both. For
images and vectors with a Gaussian likelihood, predictions with the model's own standard deviation: the mean of the
training split, and the previous observation,

.. math:: \log p(o_{1:T}) = \sum_t \log N(o_t;\, \bar o, \sigma^2), \qquad \sum_t \log N(o_t;\, o_{t-1}, \sigma^2),

where :math:`o_0 = \bar o`. Of several parts, each is predicted so, if all have a Gaussian likelihood. For vectors also
the linear prediction that fits the training split best,

.. math:: \log p(o_{1:T}) = \sum_t \log N(o_t;\, A_1 o_{t-1} + A_2 o_{t-2} + B a_{t-1} + c,\, \sigma^2)

and the previous observation for t ≤ 2. It predicts from positions and the velocities between them. A model below such a
reference predicts worse than without a belief. Sequences of a known process are held against their exact log p instead.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from forbes.data import SequenceBatch, SequenceData, Simulated, Split, Strokes
from forbes.evaluation.metrics import score_of
from forbes.evaluation.ngram import fit_ngrams
from forbes.models import Bernoulli, Likelihood, Normal, OnePixel, PartsLikelihood, SymlogNormal, VectorNormal
from forbes.seeding import forked

__all__ = ["best_reference", "lowest_above", "merge_equal", "reference_means", "references"]

_EXAMPLES, _ROWS = 500, 50
"""Number of training sequences that are averaged and fitted, at equal distances, and that are decoded at a time."""
_Gaussian = Normal | VectorNormal | SymlogNormal
_NAMES = {3: ("mean frame", "last frame"), 1: ("mean observation", "last observation")}
"""Names of the constant predictions by rank of the observation."""


def references(data: SequenceData, likelihood: Likelihood, split: Split, count: int) -> dict[str, Tensor]:
    """Return log p of each step of the first `count` sequences in nats, float64 `(N, T)`, by name; 0 on padding."""
    if _is_gaussian(likelihood) and not isinstance(data.source, Simulated):  # a density, also of strokes
        with forked("cpu", 0):  # for the dequantisation noise of coarse pixels
            return _predictions(data, likelihood, split, count)
    if isinstance(data.source, Strokes) and isinstance(likelihood, Bernoulli | OnePixel):  # not of another density
        ngrams = fit_ngrams(data.source, data.length)
        return {f"{order}-gram": values for order, values in ngrams.log_prob(split, count).items()}
    return {}


def reference_means(data: SequenceData, likelihood: Likelihood, split: Split, count: int) -> dict[str, float]:
    """Return the mean of log p over the first `count` sequences, in nats per sequence, by name; empty if count is 0."""
    found = references(data, likelihood, split, count) if count else {}
    return {name: values.sum(1).mean().item() for name, values in found.items()}


def lowest_above(score: float, means: Mapping[str, float]) -> str | None:
    """Return the name of the lowest reference above a score, or None if there is none above it."""
    above = [(mean, name) for name, mean in means.items() if mean > score]
    return min(above)[1] if above else None


def best_reference(entry: Mapping[str, Any]) -> str | None:
    """Return the name of the highest reference of an entry of `evaluation.json`, or None if it has none."""
    found: Mapping[str, Any] = entry.get("references", {})
    return max(found, key=lambda name: found[name]["mean"], default=None)


def merge_equal(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Return the rows of metrics with one row for those that are equal, since references depend on the steps only.

    `test[:20]/elbo[bernoulli,S=16]` and `test[:20]/pll[bernoulli,K=128]` become `test[:20]/elbo, pll`.
    """
    groups: dict[tuple[str, tuple[Any, ...]], list[str]] = {}
    for metric, row in rows.items():
        groups.setdefault((metric.partition("/")[0], tuple(row.items())), []).append(metric)
    return {_joined(split, metrics): dict(row) for (split, row), metrics in groups.items()}


def _joined(split: str, metrics: list[str]) -> str:
    scores = ", ".join(dict.fromkeys(map(score_of, metrics)))
    return metrics[0] if len(metrics) == 1 else f"{split}/{scores}"


def _is_gaussian(likelihood: Likelihood) -> bool:
    """Return whether a likelihood's parameters are a prediction of the target, of each part if there are several."""
    parts = likelihood.parts.values() if isinstance(likelihood, PartsLikelihood) else [likelihood]
    return all(isinstance(part, _Gaussian) for part in parts)


@torch.no_grad()
def _predictions(data: SequenceData, likelihood: Likelihood, split: Split, count: int) -> dict[str, Tensor]:
    """Return log p of each step by the mean, by the previous observation, and of vectors by the best linear map."""
    mean = _mean_target(data, likelihood)  # (*O)
    vectors = isinstance(likelihood, VectorNormal | SymlogNormal)
    weight = _least_squares(data, likelihood) if vectors else None  # (P, O)
    found: dict[str, list[Tensor]] = {}
    for index in torch.arange(count).split(_ROWS):
        batch = data.sequences(split, index)
        target = likelihood.target(batch.observation)  # (B, T, *O)
        constant, last = _NAMES[likelihood.rank]
        predicted = {constant: mean.expand_as(target), last: _delayed(target, mean)}
        if weight is not None:
            linear = (_regressors(target, batch.action) @ weight).to(target.dtype)  # (B, T - 2, O)
            predicted["linear"] = torch.cat((predicted[last][:, :2], linear), 1)  # (B, T, O)
        for name, output in predicted.items():
            found.setdefault(name, []).append(likelihood.log_prob(output, target).double() * batch.mask)
    return {name: torch.cat(parts) for name, parts in found.items()}  # (N, T)


def _train(data: SequenceData) -> Iterator[SequenceBatch]:
    size = data.source.size("train")
    count = min(_EXAMPLES, size)
    for index in (torch.arange(count) * size // count).split(_ROWS):  # the first ones may all be of one episode
        yield data.sequences("train", index)


def _mean_target(data: SequenceData, likelihood: Likelihood) -> Tensor:
    """Return the mean over all steps of training sequences, `(*O)`."""
    total, steps = torch.zeros((), dtype=torch.float64), 0
    for batch in _train(data):
        total = total + likelihood.target(batch.observation)[batch.mask].sum(0)  # (*O)
        steps += int(batch.mask.sum())
    return (total / max(steps, 1)).float()  # (*O)


def _least_squares(data: SequenceData, likelihood: Likelihood) -> Tensor:
    """Return (A_1, A_2, B, c) transposed, float64 `(P, O)`, by the normal equations of training sequences."""
    products: list[Tensor] = []
    for batch in _train(data):
        target, mask = likelihood.target(batch.observation), batch.mask[:, 2:]  # (B, T, O), (B, T - 2)
        known = _regressors(target, batch.action)[mask]  # (S, P)
        products.append(known.T @ torch.cat((known, target[:, 2:][mask].double()), -1))  # (P, P + O)
    both = torch.stack(products).sum(0)  # (P, P + O)
    size = len(both)
    weight: Tensor = torch.linalg.lstsq(both[:, :size], both[:, size:], driver="gelsd").solution  # (P, O); of any rank
    return weight


def _regressors(target: Tensor, action: Tensor) -> Tensor:
    """Return (o_{t-1}, o_{t-2}, a_{t-1}, 1) of each step from the third on, float64 `(B, T - 2, P)`."""
    known = (target[:, 1:-1], target[:, :-2], action[:, 2:], torch.ones_like(target[:, 2:, :1]))
    return torch.cat(known, -1).double()  # (B, T - 2, P)


def _delayed(target: Tensor, mean: Tensor) -> Tensor:
    """Return o_{t-1} of each step, the mean before the first, `(B, T, *O)`."""
    return torch.cat((mean.expand_as(target[:, :1]), target[:, :-1]), 1)  # (B, T, *O)
