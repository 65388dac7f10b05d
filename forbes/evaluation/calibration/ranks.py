"""Calibration of a belief from N pairs: a true value, and L samples of the belief that was held about it.

A belief is calibrated where the true value is to its samples as one more of them. Each check turns a pair into a rank
that is then uniform on 0 … L, whatever the belief (`uniformity` tests that): of the value in each dimension
(simulation-based calibration, Talts et al., 2018), of its density (expected coverage of the highest-density regions,
Hermans et al., 2022), of its distance from a random point (TARP, Lemos et al., 2023). Pairs must be
independent: of a sequence take one step. The classifier two-sample test (Lopez-Paz and Oquab, 2017) gives no rank: it
tells true values from samples.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.errors import ForbesError

__all__ = ["TwoSampleTest", "coverage", "ranks", "tarp_ranks", "two_sample_test"]


def ranks(truth: Tensor, samples: Tensor, generator: torch.Generator) -> Tensor:
    """Count the samples below the true value; of equal ones, a random number counts as below.

    Of values this is simulation-based calibration, a rank for each dimension. Of log-densities log q it is coverage:
    the true value lies in the highest-density region that holds the share 1 - rank / L of the samples.

    Args:
        truth: values or log q(truth), `(N, *)`.
        samples: as many values or log q(sample), `(L, N, *)`.
        generator: for the ties.

    Returns:
        Ranks from 0 to L, `(N, *)`, int64.
    """
    _require_pairs("ranks", truth, samples)
    below, equal = (samples < truth).sum(0), (samples == truth).sum(0)  # (N, *), (N, *)
    chance = torch.rand(equal.shape, generator=generator, dtype=torch.float64, device=truth.device)
    return below + (chance * (equal + 1)).long()


def tarp_ranks(truth: Tensor, samples: Tensor, generator: torch.Generator) -> Tensor:
    """Rank the true value among the samples by the distance from a point that knows nothing of it (TARP).

    The first sample of each pair is left out of the ranking: it is the point for the next pair, and all of them give
    the scale of each dimension. So neither depends on what is ranked.

    Args:
        truth: `(N, D)`.
        samples: `(L + 1, N, D)`.
        generator: for the ties.

    Returns:
        Ranks from 0 to L, `(N,)`, int64; f of the paper is rank / L.
    """
    _require_values("tarp_ranks", truth, samples, pairs=2)
    reference = samples[0].roll(1, 0)  # (N, D)
    scale = _scale(samples[0])  # (D,)
    distances = [((values - reference) / scale).square().sum(-1) for values in (truth, samples[1:])]  # (N,), (L, N)
    return ranks(distances[0], distances[1], generator)


def coverage(density_ranks: Tensor, samples: int, levels: Tensor) -> Tensor:
    r"""Measure how often the true value lies in the belief's highest-density regions.

    A region of nominal level a holds the values of which more than 1 - a of the samples have a lower density; between
    two of the L + 1 steps a rank counts by its share, so the expectation is a at every level for a calibrated belief:

    .. math:: \frac1N \sum_i \mathrm{clip}\big(a (L + 1) - (L - r_i),\, 0,\, 1\big)

    Args:
        density_ranks: r_i, `ranks` of log q, `(N,)`.
        samples: L.
        levels: nominal, in [0, 1], `(A,)`.

    Returns:
        Shares of the N values, `(A,)`, float64; `binomial_interval(N, levels, 0.95)` is their band.
    """
    above = samples - density_ranks  # (N,)
    return (levels.double()[:, None] * (samples + 1) - above).clamp(0, 1).mean(-1)


class TwoSampleTest(NamedTuple):
    """How well a classifier tells true values from samples of the beliefs about them."""

    accuracy: float
    """On pairs it was not fitted to; its expectation is 0.5 for a calibrated belief."""
    p_value: float
    """Share of random exchanges within the pairs that are told apart as well."""


def two_sample_test(
    truth: Tensor, samples: Tensor, generator: torch.Generator, folds: int = 5, permutations: int = 199
) -> TwoSampleTest:
    """Tell the true value from the first sample of its belief, given the mean m of the others (C2ST).

    What is classified is (s - m, m). Each value gets the label of most of its k nearest neighbours in the other folds,
    k near the root of their number. The two values of a pair share m, so they are never independent, and a pair is
    never split: folds are of pairs, and a permutation exchanges the two labels within each of a random half of the
    pairs. For a calibrated belief such an exchange changes no distribution, hence the p-value is valid at any N.

    Args:
        truth: `(N, D)`.
        samples: `(L + 1, N, D)`.
        generator: for the folds and the permutations.
        folds: number of parts.
        permutations: number of random exchanges.
    """
    _require_values("two_sample_test", truth, samples, pairs=2 * folds)
    count, centre = len(truth), samples[1:].mean(0)  # N, (N, D)
    values = torch.stack([torch.cat((one - centre, centre), -1) for one in (truth, samples[0])])  # (2, N, 2 D)
    values = values / _scale(values.flatten(0, 1))
    neighbours = torch.empty(2, count, _neighbours(count, folds), dtype=torch.long)  # (2, N, K), of 2 N in a row
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
    """Return the odd number, at most the root of the number of values in the other folds: no vote is a tie."""
    return (math.isqrt(2 * (pairs - math.ceil(pairs / folds))) - 1) // 2 * 2 + 1


def _accuracy(label: Tensor, neighbours: Tensor) -> float:
    votes = label.flatten()[neighbours].double().mean(-1)  # (2, N)
    return ((votes > 0.5) == label).double().mean().item()


def _scale(values: Tensor) -> Tensor:
    """Return the standard deviation of each dimension, `(N, D)` to `(D,)`; 1 where there is none."""
    deviation = values.std(0)
    return torch.where(deviation > 0, deviation, 1)


def _require_pairs(where: str, truth: Tensor, samples: Tensor) -> None:
    if samples.shape[1:] != truth.shape:
        raise ForbesError(
            f"{where}: {tuple(samples.shape)} samples for {tuple(truth.shape)} true values, expected (L, N, ...) for "
            "(N, ...). Draw the samples of all pairs along the first dimension"
        )
    if truth.isnan().any() or samples.isnan().any():
        raise ForbesError(f"{where}: there are NaN, expected numbers. Look for the step at which the belief diverged")


def _require_values(where: str, truth: Tensor, samples: Tensor, pairs: int) -> None:
    """Require what distances are made of: finite values, one sample more than is compared, and enough pairs."""
    _require_pairs(where, truth, samples)
    if len(samples) < 2 or len(truth) < pairs:
        raise ForbesError(
            f"{where}: {len(truth)} pairs with {len(samples)} samples, expected at least {pairs} and 2. Draw more"
        )
    if truth.isinf().any() or samples.isinf().any():
        raise ForbesError(f"{where}: there are infinite values, expected finite ones. Look at how they were drawn")
