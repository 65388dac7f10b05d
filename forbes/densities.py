"""The density of a normal distribution, in one place."""

import math

from torch import Tensor

__all__ = ["log_normal"]


def log_normal(value: Tensor, mean: Tensor, std: Tensor | float) -> Tensor:
    r"""Return :math:`\log N(x; \mu, \sigma^2)` of each number in nats.

    .. math:: -\tfrac12 \left(\tfrac{x - \mu}{\sigma}\right)^2 - \log\sigma - \tfrac12 \log 2\pi

    Functions that are fused into a kernel or run in a time loop keep a form of their own, which sums before it adds the
    constants: `beliefs/gaussian.py`, `control/policy.py`, `models/likelihoods.py`.

    Args:
        value: x; broadcasts with `mean` and `std`.
        mean: :math:`\mu`.
        std: :math:`\sigma`, above 0.
    """
    log_std = std.log() if isinstance(std, Tensor) else math.log(std)
    return -0.5 * ((value - mean) / std).square() - (log_std + 0.5 * math.log(2 * math.pi))
