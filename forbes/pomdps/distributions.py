"""The densities a process is made of: each evaluates itself, in nats, and draws from a generator."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from forbes.densities import log_normal

__all__ = ["DiagonalGaussian", "Distribution", "PointMass", "draw_index", "draw_normal"]


class Distribution(ABC):
    """A distribution of a vector, with any leading shape `(*)` of independent parameters."""

    @abstractmethod
    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density in nats: `(..., *, D)` to `(..., *)`, which broadcast."""

    @abstractmethod
    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw `count` times from each: `(count, *, D)`, a pure function of the generator's state."""


class DiagonalGaussian(Distribution):
    r"""Independent Gaussians :math:`\prod_d N(x_d; \mu_d, \sigma_d^2)`.

    Args:
        mean: :math:`\mu`, `(*, D)`.
        std: :math:`\sigma`, broadcasts with the mean.
    """

    def __init__(self, mean: Tensor, std: Tensor | float) -> None:
        self.mean = mean
        self.std = torch.as_tensor(std, dtype=mean.dtype, device=mean.device)

    def log_prob(self, value: Tensor) -> Tensor:
        """See `Distribution.log_prob`; differentiable in the value and in both parameters."""
        return log_normal(value, self.mean, self.std).sum(-1)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """See `Distribution.sample`; reparameterised."""
        return self.mean + self.std * draw_normal((count, *self.mean.shape), generator, self.mean)


class PointMass(Distribution):
    """A value that is certain. It has no density: `log_prob` is log P, 0 at the point and -inf elsewhere.

    Args:
        point: `(*, D)`.
    """

    def __init__(self, point: Tensor) -> None:
        self.point = point

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log P: 0 where the value is the very point, else -inf."""
        return torch.where((value == self.point).all(-1), 0.0, -torch.inf).to(self.point)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """See `Distribution.sample`; nothing is drawn."""
        return self.point.expand(count, *self.point.shape)  # (count, *, D)


def draw_normal(shape: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Draw standard normals on the generator's device, in the dtype and on the device of `like`."""
    return torch.randn(shape, generator=generator, device=generator.device, dtype=like.dtype).to(like.device)


def draw_index(log_mass: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw `count` indices from each row of log-probabilities: `(*, N)` to int64 `(count, *)`."""
    mass = log_mass.exp().reshape(-1, log_mass.shape[-1])  # (M, N), M rows
    index = torch.multinomial(mass, count, replacement=True, generator=generator)  # (M, count)
    return index.T.reshape(count, *log_mass.shape[:-1])  # (count, *)
