"""Means over sequences with their standard errors."""

import math
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
    def of(cls, values: Tensor) -> "Estimate":
        """Average one value per sequence, `(N,)`, N at least 2."""
        return cls(values.mean().item(), values.std().item() / math.sqrt(len(values)))

    @classmethod
    def per_step(cls, values: Tensor, steps: Tensor) -> "Estimate":
        r"""Average over all steps of all sequences, :math:`\sum_i v_i / \sum_i T_i`, with the error of a ratio.

        Args:
            values: sum :math:`v_i` over the steps of each sequence, `(N,)`.
            steps: number of steps without padding, :math:`T_i`, `(N,)`.
        """
        mean = values.sum() / steps.sum()
        residual = (values - mean * steps) / steps.double().mean()  # (N,)
        return cls(mean.item(), residual.std().item() / math.sqrt(len(values)))

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.standard_error:.2f}"


def bootstrap_interval(values: Tensor, level: float = 0.95, seed: int = 0) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean of `values`, `(N,)`, which need not be symmetric."""
    draw = generator(seed, "bootstrap", len(values))
    index = torch.randint(len(values), (_RESAMPLES, len(values)), generator=draw)  # (R, N)
    tail = (1 - level) / 2
    low, high = values[index].mean(1).quantile(torch.tensor([tail, 1 - tail], dtype=values.dtype))
    return low.item(), high.item()
