"""Test whether ranks are uniform on 0 … L: p-values that hold for discrete ranks, and bands for figures.

Ranks of a calibrated belief are independent and uniform on the L + 1 integers 0 … L. The two tests complement each
other: Kolmogorov-Smirnov detects bias (ranks low or high overall), Pearson detects over- and under-dispersion (ranks in
the middle, or at both ends).
"""

import math

import torch
from torch import Tensor

from forbes.errors import ForbesError

__all__ = ["BINS", "binomial_interval", "ecdf_band", "kolmogorov_smirnov", "pearson", "spread"]

BINS = 10
"""Default number of bins of ranks."""


def pearson(ranks: Tensor, samples: int, bins: int = BINS) -> Tensor:
    r"""Return the p-value of Pearson's :math:`\chi^2` test over nearly equal bins.

    .. math:: \chi^2 = \sum_b (n_b - N p_b)^2 / (N p_b), \qquad p_b = \text{ranks in bin } b \,/\, (L + 1)

    Args:
        ranks: integers in 0 … L, `(N, *)`. Each column is tested separately.
        samples: number of samples that were ranked, L.
        bins: number of bins, at most L + 1. At the 5 % level the false-alarm rate is 4.8 % with 5 ranks per bin, 4.9 %
            with 10.

    Returns:
        p-values, `(*)`, float64.
    """
    if bins > samples + 1 or len(ranks) < 5 * bins:
        raise ForbesError(
            f"pearson: {len(ranks)} ranks among {samples} samples for {bins} bins, expected 5 ranks per bin and at "
            f"most {samples + 1} bins. Choose fewer bins, or rank more states"
        )
    bin_of = torch.arange(samples + 1, device=ranks.device) * bins // (samples + 1)  # (L + 1,)
    expected = len(ranks) * torch.bincount(bin_of).double() / (samples + 1)  # (bins,)
    counts = torch.nn.functional.one_hot(bin_of[ranks], bins).sum(0)  # (*, bins)
    statistic = ((counts - expected).square() / expected).sum(-1)  # (*)
    freedom = torch.full_like(statistic, (bins - 1) / 2)
    p_value: Tensor = torch.special.gammaincc(freedom, statistic / 2)
    return p_value


def spread(ranks: Tensor, samples: int, generator: torch.Generator) -> Tensor:
    """Map uniform ranks on 0 … L to uniform values on [0, 1], (rank + U) / (L + 1): `(*)`, float64."""
    noise = torch.rand(ranks.shape, generator=generator, dtype=torch.float64, device=ranks.device)
    return (ranks + noise) / (samples + 1)


def kolmogorov_smirnov(values: Tensor) -> Tensor:
    r"""Return the p-value of the Kolmogorov-Smirnov test against U(0, 1). For ranks, pass the result of `spread`.

    .. math:: D = \sup_x |\hat F(x) - x|, \qquad p = 2 \sum_k (-1)^{k-1} e^{-2 k^2 x^2},
              \qquad x = D\sqrt N + \frac{1}{6\sqrt N} + \frac{D\sqrt N - 1}{4N}

    The asymptotic series evaluated at x instead of D √N (Vrbik, 2018) has an error below 3e-4 for N ≥ 50.

    Args:
        values: values in [0, 1], `(N, *)`. Each column is tested separately.

    Returns:
        p-values, `(*)`, float64.
    """
    count, ordered = len(values), values.double().movedim(0, -1).sort(-1).values  # (*, N)
    steps = torch.arange(count + 1, dtype=torch.float64, device=values.device) / count
    distance = torch.maximum(steps[1:] - ordered, ordered - steps[:-1]).amax(-1)  # (*)
    root = math.sqrt(count)
    x = distance * root + 1 / (6 * root) + (distance * root - 1) / (4 * count)
    x = x.clamp_min(0.2)  # below 0.2, p is 1 to twelve digits and the series converges slowly
    k = torch.arange(1, 21, dtype=torch.float64, device=values.device)
    terms = 2 * (-1) ** (k - 1) * (-2 * (k * x[..., None]).square()).exp()  # (*, 20)
    return terms.sum(-1).clamp(0, 1)


def binomial_interval(count: int, probability: Tensor, confidence: float) -> tuple[Tensor, Tensor]:
    """Return the central interval of a binomial proportion: at most (1 - confidence) / 2 lies beyond each end.

    Args:
        count: number of trials, N.
        probability: success probability, `(A,)`.
        confidence: probability that the proportion is inside.

    Returns:
        Smallest and largest proportion inside, `(A,)` each, float64.
    """
    tail = (1 - confidence) / 2
    below = _binomial_cdf(count, probability)  # (A, N + 1)
    low = (below <= tail).sum(-1)  # smallest k with P(at most k successes) > tail
    high = (below < 1 - tail).sum(-1)
    return low.double() / count, high.double() / count


def _binomial_cdf(count: int, probability: Tensor) -> Tensor:
    """Return P(at most k successes) for k = 0 … N, `(A,)` to `(A, N + 1)`."""
    k = torch.arange(count + 1, dtype=torch.float64)
    p = probability.double()[:, None]
    ways = math.lgamma(count + 1) - torch.lgamma(k + 1) - torch.lgamma(count - k + 1)
    log_mass = ways + torch.xlogy(k, p) + torch.xlogy(count - k, 1 - p)  # (A, N + 1)
    return log_mass.exp().cumsum(-1).clamp(max=1)


def ecdf_band(
    count: int, samples: int, confidence: float, generator: torch.Generator, simulations: int = 2000
) -> tuple[Tensor, Tensor]:
    """Return a simultaneous band for the empirical distribution function of N uniform ranks (Säilynoja et al., 2022).

    At each rank it is a binomial interval. Their common level is found by simulation.

    Args:
        count: number of ranks, N.
        samples: number of samples that were ranked, L.
        confidence: probability that the whole function is inside the band.
        generator: random generator for the simulated ranks.
        simulations: number of simulations.

    Returns:
        Lower and upper end of the band for k = 0 … L - 1, as a fraction of ranks at most k, `(L,)` each.
    """
    probability = torch.arange(1, samples + 1, dtype=torch.float64) / (samples + 1)  # (L,)
    below = _binomial_cdf(count, probability)  # (L, N + 1)
    above = 1 - torch.nn.functional.pad(below, (1, -1))  # (L, N + 1), P(at least k)
    drawn = torch.randint(samples + 1, (simulations, count), generator=generator)
    counts = torch.zeros(simulations, samples + 1, dtype=torch.long).scatter_add_(1, drawn, torch.ones_like(drawn))
    at_most = counts.cumsum(-1)[:, :-1]  # (S, L)
    tails = torch.minimum(below, above).expand(simulations, -1, -1)
    worst = tails.gather(-1, at_most[..., None]).squeeze(-1).amin(-1)  # (S,), smallest tail probability over k
    return binomial_interval(count, probability, 1 - 2 * worst.quantile(1 - confidence).item())
