"""Observation likelihoods p(o_t | features): what a decoder's output means. Fully normalised, in nats."""

import math
from abc import ABC, abstractmethod

from torch import Tensor
from torch.nn.functional import softplus

__all__ = ["Bernoulli", "Likelihood", "Normal"]


class Likelihood(ABC):
    """A density of the observation given the decoder's output. Its name is part of the name of every metric."""

    name: str

    @abstractmethod
    def target(self, observation: Tensor) -> Tensor:
        """Scale a stored observation (uint8) to the values the encoder reads and the density is about, float32."""

    @abstractmethod
    def mean(self, output: Tensor) -> Tensor:
        """Give E[o | output] as a grey value in [0, 1], for pictures; shape of `output`."""

    @abstractmethod
    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """Give log p(target | output) in nats, summed over the three image dimensions: `(*, C, H, W)` to `(*)`."""


class Bernoulli(Likelihood):
    r"""Binary pixels with the output u as logit: :math:`\log p(x) = \sum x u - \mathrm{softplus}(u)`."""

    name = "bernoulli"

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: 0/1 as they are."""
        return observation.float()

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`."""
        return output.sigmoid()

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        return (output * target - softplus(output)).sum((-3, -2, -1))


class Normal(Likelihood):
    r"""Pixels of fixed spread: :math:`N(x/scale - 1/2;\, output,\, \sigma^2)`, constant kept.

    Args:
        std: :math:`\sigma`; 1 in PlaNet, Dreamer and the paper.
        scale: the largest stored value, 255 for images and 1 for binary frames.
    """

    def __init__(self, std: float = 1.0, scale: float = 255.0) -> None:
        self.std = std
        self.scale = scale
        self.name = f"normal({std:g})"

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: values in [-1/2, 1/2]."""
        return observation.float() / self.scale - 0.5

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`."""
        return (output + 0.5).clamp(0, 1)

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        constant = math.log(self.std) + 0.5 * math.log(2 * math.pi)
        error = ((target - output) / self.std).square().sum((-3, -2, -1))
        return -0.5 * error - constant * math.prod(target.shape[-3:])
