"""Means over sequences with their standard errors; sequences that are parts of one episode are not independent."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.seeding import generator

__all__ = ["Estimate", "bootstrap_interval"]

_RESAMPLES = 1000


class Estimate(NamedTuple):
    """A mean over sequences and its standard error."""

    mean: float
    standard_error: float

    @classmethod
    def of(cls, values: Tensor, episodes: Sequence[int] | None = None) -> "Estimate":
        r"""Average one value per sequence, `(N,)`, N at least 2.

        The error is that of a mean of independent sequences, :math:`\mathrm{std}(v) / \sqrt N`, or of independent
        episodes g, G of them, whose sequences may depend on each other in any way:

        .. math:: \frac1N \sqrt{\frac{G}{G - 1} \sum_g \Big(\sum_{i \in g} (v_i - \bar v)\Big)^2}

        Args:
            values: value :math:`v_i` of each sequence, `(N,)`.
            episodes: number of the episode of each sequence; by default each has its own. Of a single one the error
                cannot be known: that of sequences is returned, which is too small.
        """
        return cls(values.mean().item(), _error(values - values.mean(), episodes))

    @classmethod
    def per_step(cls, values: Tensor, steps: Tensor, episodes: Sequence[int] | None = None) -> "Estimate":
        r"""Average over all steps of all sequences, :math:`\sum_i v_i / \sum_i T_i`, with the error of a ratio.

        Args:
            values: sum :math:`v_i` over the steps of each sequence, `(N,)`.
            steps: number of steps without padding, :math:`T_i`, `(N,)`.
            episodes: as for `of`.
        """
        mean = values.sum() / steps.sum()
        return cls(mean.item(), _error((values - mean * steps) / steps.double().mean(), episodes))

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.standard_error:.2f}"


def bootstrap_interval(
    values: Tensor, episodes: Sequence[int] | None = None, level: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean of `values`, `(N,)`, which need not be symmetric.

    Whole episodes are drawn, if there are several; see `Estimate.of`.
    """
    sums, counts = _sums(values, episodes), _sums(torch.ones_like(values), episodes)  # (G,)
    draw = generator(seed, "bootstrap", len(sums))
    index = torch.randint(len(sums), (_RESAMPLES, len(sums)), generator=draw)  # (R, G)
    tail = (1 - level) / 2
    means = sums[index].sum(1) / counts[index].sum(1)  # (R,)
    low, high = means.quantile(torch.tensor([tail, 1 - tail], dtype=values.dtype))
    return low.item(), high.item()


def _error(residual: Tensor, episodes: Sequence[int] | None) -> float:
    """Return the standard error of a mean of values with these deviations from it, `(N,)`."""
    sums = _sums(residual, episodes)  # (G,)
    number = len(sums)
    return math.sqrt(sums.square().sum().item() * number / (number - 1)) / len(residual)


def _sums(values: Tensor, episodes: Sequence[int] | None) -> Tensor:
    """Return the sums over episodes, `(G,)`; the values themselves if there are not several."""
    if episodes is None or len({*episodes}) < 2:
        return values
    _, group = torch.tensor(episodes).unique(return_inverse=True)  # (N,)
    return values.new_zeros(int(group.max()) + 1).index_add(0, group, values)
