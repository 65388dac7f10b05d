r"""Scores of sampled completions, by class and by pixel, for each sequence, in float64.

Notation: N completions :math:`x_k` of a sequence, its truth y, P pixels, class distributions p and q.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

__all__ = ["average_of", "best_of", "crps", "energy_score", "entropy", "grey_ink", "jensen_shannon", "ratio_values"]

_GREY = (0.1, 0.9)


def entropy(p: Tensor) -> Tensor:
    r"""Return :math:`H[p] = -\sum_y p(y) \log p(y)` in nats, `(*, Y)` to `(*)`."""
    total: Tensor = torch.special.entr(p.double()).sum(-1)
    return total


def jensen_shannon(p: Tensor, q: Tensor) -> Tensor:
    r"""Return the Jensen-Shannon divergence in nats, `(*, Y)` twice to `(*)`: 0 for equal distributions, at most log 2.

    .. math:: \mathrm{JS}(p, q) = H\big[\tfrac12 (p + q)\big] - \tfrac12 H[p] - \tfrac12 H[q]
    """
    return entropy((p.double() + q.double()) / 2) - (entropy(p) + entropy(q)) / 2


def energy_score(samples: Tensor, truth: Tensor) -> Tensor:
    r"""Return the energy score, proper for all pixels jointly; lower is better (Gneiting and Raftery, 2007).

    .. math:: \frac1N \sum_k \lVert x_k - y \rVert - \frac1{2N(N-1)} \sum_{k \ne l} \lVert x_k - x_l \rVert

    It is unbiased for any N. For binary pixels the distance is the root of the number of pixels that differ.

    Args:
        samples: completions :math:`x_k`, `(N, B, P)`, N at least 2.
        truth: true image y, `(B, P)`.
    """
    count = len(samples)
    drawn = samples.double().transpose(0, 1)  # (B, N, P)
    to_truth = torch.cdist(drawn, truth.double()[:, None]).mean((1, 2))  # (B,)
    apart = torch.cdist(drawn, drawn)  # (B, N, N)
    return to_truth - apart.sum((1, 2)) / (2 * count * (count - 1))


def crps(means: Tensor, truth: Tensor) -> Tensor:
    r"""Return the continuous ranked probability score, summed over pixels; lower is better.

    .. math:: \sum_i \mathrm E|X_i - y_i| - \tfrac12 \mathrm E|X_i - X'_i| = \sum_i (p_i - y_i)^2, \qquad
              p_i^2 \approx \frac1{N(N-1)} \sum_{k \ne l} x_{ki} x_{li}

    for binary pixels :math:`X_i \sim \mathrm{Bernoulli}(p_i)` with p the mean of all completions: the Brier score. The
    products of different completions make it unbiased for any N. It scores each pixel by itself, so it favours blurs.

    Args:
        means: grey values :math:`x_k` in [0, 1], `(N, B, P)`, N at least 2.
        truth: true image y in {0, 1}, `(B, P)`.
    """
    count = len(means)
    grey, y = means.double(), truth.double()
    total = grey.sum(0)  # (B, P)
    square = (total.square() - grey.square().sum(0)) / (count * (count - 1))  # (B, P)
    return (square - 2 * y * total / count + y).sum(-1)


def best_of(errors: Tensor) -> Tensor:
    r"""Return the expected smallest error of n completions out of N, for every n, exactly over all subsets.

    .. math:: \sum_k e_{(k)} \binom{N - k}{n - 1} \Big/ \binom Nn, \qquad e_{(1)} \le \dots \le e_{(N)}

    since the k-th smallest error is the smallest of a subset if the other n - 1 come from the N - k above it.

    Args:
        errors: error of each completion, `(N, B)`.

    Returns:
        A curve over n = 1 … N for each sequence, `(B, N)`.
    """
    ordered = errors.double().sort(0).values.T  # (B, N)
    return ordered @ _least_of(len(errors)).to(ordered.device)


@lru_cache(maxsize=4)
def _least_of(count: int) -> Tensor:
    """Return the probability that the k-th smallest of N is the smallest of n, `(N, N)` over k and n."""
    chances = [
        [math.comb(count - k, n - 1) / math.comb(count, n) for n in range(1, count + 1)] for k in range(1, count + 1)
    ]
    return torch.tensor(chances, dtype=torch.float64)


def average_of(means: Tensor, truth: Tensor) -> Tensor:
    r"""Return the expected squared error of the average image of n completions out of N, for every n.

    .. math:: \lVert \bar x - y \rVert^2 + \Big(\frac1n - \frac1N\Big) \frac1{N-1} \sum_k \lVert x_k - \bar x \rVert^2

    exactly over all subsets. It falls with n even for blurred averages, so the gain of `best_of` beyond it is due to
    accuracy, not to hedging.

    Args:
        means: grey values, `(N, B, P)`, N at least 2.
        truth: true image, `(B, P)`.

    Returns:
        A curve over n = 1 … N for each sequence, `(B, N)`.
    """
    count = len(means)
    average = means.double().mean(0)  # (B, P)
    error = (average - truth).square().sum(-1)  # (B,)
    spread = (means - average).square().sum((0, 2)) / (count - 1)  # (B,)
    factor = 1 / torch.arange(1, count + 1, dtype=torch.float64, device=error.device) - 1 / count  # (N,)
    return error[:, None] + spread[:, None] * factor


def grey_ink(means: Tensor) -> Tensor:
    r"""Return the fraction of an image's ink that is grey, `(*, P)` to `(*)`: 0 for a binary image, high for a blur.

    .. math:: \sum_i x_i\, 1[0.1 < x_i < 0.9] \Big/ \sum_i x_i
    """
    low, high = _GREY
    ink = means.double()
    grey = ink * ((ink > low) & (ink < high))
    return grey.sum(-1) / ink.sum(-1).clamp(min=1e-12)  # 0 for an empty image


def ratio_values(part: Tensor, whole: Tensor) -> Tensor:
    r"""Return a value per sequence whose mean is a ratio of sums and whose standard error is that of the ratio.

    .. math:: v_i = R + \frac{a_i - R\,b_i}{\bar b}, \qquad R = \sum_i a_i \Big/ \sum_i b_i

    Args:
        part: numerators a, `(B,)`.
        whole: denominators b, `(B,)`, not all 0.
    """
    ratio = part.sum() / whole.sum()
    return ratio + (part - ratio * whole) / whole.mean()
