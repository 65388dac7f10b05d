"""Calibration of a belief from N pairs of a true value and L samples of the belief about it.

A belief is calibrated if the true value is distributed like one more sample. Each check turns a pair into a rank, which
is uniform on 0 … L for a calibrated belief (see `uniformity`): the rank of the value in each dimension
(simulation-based calibration, Talts et al., 2018), of its density (expected coverage of the highest-density regions,
Hermans et al., 2022), or of its distance from a random point (TARP, Lemos et al., 2023). Pairs must be independent, so
use one step per sequence. The classifier two-sample test (Lopez-Paz and Oquab, 2017) does not use ranks: it tries to
separate true values from samples.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.errors import ForbesError

__all__ = ["TwoSampleTest", "coverage", "ranks", "tarp_ranks", "two_sample_test"]


def ranks(truth: Tensor, samples: Tensor, generator: torch.Generator) -> Tensor:
    """Return the number of samples below the true value, with ties broken at random.

    For values, this is simulation-based calibration, with one rank per dimension. For log-densities log q, it is
    coverage: the true value lies in the highest-density region that contains a fraction 1 - rank / L of the samples.

    Args:
        truth: true values, or log q(truth), `(N, *)`.
        samples: samples, or log q(sample), `(L, N, *)`.
        generator: random generator for the ties.

    Returns:
        Ranks from 0 to L, `(N, *)`, int64.
    """
    _require_pairs("ranks", truth, samples)
    below, equal = (samples < truth).sum(0), (samples == truth).sum(0)  # (N, *), (N, *)
    chance = torch.rand(equal.shape, generator=generator, dtype=torch.float64, device=truth.device)
    return below + (chance * (equal + 1)).long()


def tarp_ranks(truth: Tensor, samples: Tensor, generator: torch.Generator) -> Tensor:
    """Rank the true value among the samples by the distance from an independent reference point (TARP).

    The first sample of each pair is not ranked. It is the reference point of the next pair, and the first samples of
    all pairs determine the scale of each dimension, so both are independent of the ranked values.

    Args:
        truth: true values, `(N, D)`.
        samples: samples, `(L + 1, N, D)`.
        generator: random generator for the ties.

    Returns:
        Ranks from 0 to L, `(N,)`, int64; f in the paper is rank / L.
    """
    _require_values("tarp_ranks", truth, samples, pairs=2)
    reference = samples[0].roll(1, 0)  # (N, D)
    scale = _scale(samples[0])  # (D,)
    distances = [((values - reference) / scale).square().sum(-1) for values in (truth, samples[1:])]  # (N,), (L, N)
    return ranks(distances[0], distances[1], generator)


def coverage(density_ranks: Tensor, samples: int, levels: Tensor) -> Tensor:
    r"""Return the coverage of the belief's highest-density regions.

    The region of nominal level a contains a value if more than a fraction 1 - a of the samples have a lower density.
    Between two of the L + 1 steps a rank counts fractionally, so a calibrated belief has the expectation a at every
    level:

    .. math:: \frac1N \sum_i \mathrm{clip}\big(a (L + 1) - (L - r_i),\, 0,\, 1\big)

    Args:
        density_ranks: ranks r_i of log q from `ranks`, `(N,)`.
        samples: number of samples that were ranked, L.
        levels: nominal levels in [0, 1], `(A,)`.

    Returns:
        Coverage at each level, `(A,)`, float64; its band is `binomial_interval(N, levels, 0.95)`.
    """
    above = samples - density_ranks  # (N,)
    return (levels.double()[:, None] * (samples + 1) - above).clamp(0, 1).mean(-1)


class TwoSampleTest(NamedTuple):
    """Result of a classifier that separates true values from samples of the beliefs about them."""

    accuracy: float
    """Accuracy on held-out pairs; 0.5 in expectation for a calibrated belief."""
    p_value: float
    """Fraction of label permutations with at least this accuracy."""


def two_sample_test(
    truth: Tensor, samples: Tensor, generator: torch.Generator, folds: int = 5, permutations: int = 199
) -> TwoSampleTest:
    """Classify true values against the first sample of their belief, given the mean m of the other samples (C2ST).

    The input of the classifier is (s - m, m). Each value gets the majority label of its k nearest neighbours in the
    other folds, with k near the root of their number. The two values of a pair share m and are not independent, so a
    pair is never split: folds consist of pairs, and a permutation swaps the two labels in a random half of the pairs.
    For a calibrated belief a swap does not change the distribution, hence the p-value is valid for any N.

    Args:
        truth: true values, `(N, D)`.
        samples: samples, `(L + 1, N, D)`.
        generator: random generator for the folds and the permutations.
        folds: number of folds.
        permutations: number of permutations.
    """
    _require_values("two_sample_test", truth, samples, pairs=2 * folds)
    count, centre = len(truth), samples[1:].mean(0)  # N, (N, D)
    values = torch.stack([torch.cat((value - centre, centre), -1) for value in (truth, samples[0])])  # (2, N, 2 D)
    values = values / _scale(values.flatten(0, 1))
    neighbours = torch.empty(2, count, _neighbours(count, folds), dtype=torch.long)  # (2, N, K), indices in 0 … 2 N - 1
    order = torch.randperm(count, generator=generator)
    for fold in order.chunk(folds):
        others = order[~torch.isin(order, fold)]  # (N - F,)
        others = torch.cat((others, others + count))  # (2 (N - F),)
        distance = torch.cdist(values[:, fold], values.flatten(0, 1)[others])  # (2, F, 2 (N - F))
        neighbours[:, fold] = others[distance.topk(neighbours.shape[-1], largest=False).indices]
    label = torch.tensor([[False], [True]]).expand(2, count)  # (2, N), True for a sample
    accuracy = _accuracy(label, neighbours)
    exchanges = torch.rand(permutations, count, generator=generator) < 0.5  # (P, N)
    as_good = sum(_accuracy(label ^ exchange, neighbours) >= accuracy for exchange in exchanges)
    return TwoSampleTest(accuracy, (1 + as_good) / (1 + permutations))


def _neighbours(pairs: int, folds: int) -> int:
    """Return the largest odd number below the root of the number of values in the other folds; odd to avoid ties."""
    return (math.isqrt(2 * (pairs - math.ceil(pairs / folds))) - 1) // 2 * 2 + 1


def _accuracy(label: Tensor, neighbours: Tensor) -> float:
    votes = label.flatten()[neighbours].double().mean(-1)  # (2, N)
    return ((votes > 0.5) == label).double().mean().item()


def _scale(values: Tensor) -> Tensor:
    """Return the standard deviation of each dimension, `(N, D)` to `(D,)`; 1 for constant dimensions."""
    deviation = values.std(0)
    return torch.where(deviation > 0, deviation, 1)


def _require_pairs(where: str, truth: Tensor, samples: Tensor) -> None:
    if samples.shape[1:] != truth.shape:
        raise ForbesError(
            f"{where}: samples have shape {tuple(samples.shape)} and true values {tuple(truth.shape)}, expected "
            "(L, N, ...) and (N, ...). Stack the samples along the first dimension"
        )
    if truth.isnan().any() or samples.isnan().any():
        raise ForbesError(
            f"{where}: there are NaN values, expected numbers. Find the step at which the belief diverged"
        )


def _require_values(where: str, truth: Tensor, samples: Tensor, pairs: int) -> None:
    """Require finite values, one sample more than is ranked, and enough pairs."""
    _require_pairs(where, truth, samples)
    if len(samples) < 2 or len(truth) < pairs:
        raise ForbesError(
            f"{where}: {len(truth)} pairs with {len(samples)} samples, expected at least {pairs} and 2. Draw more"
        )
    if truth.isinf().any() or samples.isinf().any():
        raise ForbesError(f"{where}: there are infinite values, expected finite ones. Check how they were sampled")
