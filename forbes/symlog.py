"""Numbers of unknown scale: symlog, its inverse, and the two-hot code (DreamerV3, Hafner et al., arXiv 2301.04104)."""

import torch
from torch import Tensor

__all__ = ["symexp", "symlog", "two_hot"]


def symlog(x: Tensor) -> Tensor:
    r"""Return :math:`\mathrm{sign}(x) \log(1 + |x|)`: about x near 0, a logarithm far from it (DreamerV3, eq. 10)."""
    return x.sign() * x.abs().log1p()


def symexp(x: Tensor) -> Tensor:
    r"""Return :math:`\mathrm{sign}(x) (e^{|x|} - 1)`, the inverse of `symlog`."""
    return x.sign() * x.abs().expm1()


def two_hot(value: Tensor, bins: Tensor) -> Tensor:
    r"""Spread each number over its two nearest bins such that their weighted mean is the number (DreamerV3, eq. 9).

    .. math:: w_k = \frac{b_{k+1} - x}{b_{k+1} - b_k}, \qquad w_{k+1} = 1 - w_k, \qquad b_k \le x \le b_{k+1}

    Numbers beyond the outermost bins become these.

    Args:
        value: x, `(*)`.
        bins: b in ascending order, `(K,)`.

    Returns:
        w, `(*, K)`, of sum 1.
    """
    value = value.clamp(bins[0], bins[-1])
    below = (torch.searchsorted(bins, value.contiguous(), right=True) - 1).clamp(max=len(bins) - 2)  # (*)
    share = (value - bins[below]) / (bins[below + 1] - bins[below])  # (*), of the upper one
    weights = value.new_zeros(*value.shape, len(bins))
    weights.scatter_(-1, below[..., None], 1 - share[..., None])
    return weights.scatter(-1, below[..., None] + 1, share[..., None])  # (*, K)
