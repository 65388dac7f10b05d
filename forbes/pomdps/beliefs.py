"""Exact beliefs with one interface: Gaussian mixtures, densities on a grid, and finite distributions."""

import math
from abc import abstractmethod

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from forbes.pomdps.distributions import Distribution, draw_index, draw_normal

__all__ = ["ExactBelief", "FiniteBelief", "GaussianMixtureBelief", "GridBelief"]


class ExactBelief(Distribution):
    r"""A distribution of :math:`s_t` given :math:`o_{1:t}` for every sequence and step, so `(*)` is `(B, T)`."""

    @property
    @abstractmethod
    def mean(self) -> Tensor:
        """E[s], `(*, D)`."""

    @property
    @abstractmethod
    def variance(self) -> Tensor:
        """Var[s] of each dimension, `(*, D)`."""

    @property
    @abstractmethod
    def entropy(self) -> Tensor | None:
        r""":math:`-E \log p(s)` in nats, `(*)`; None if it has no closed form and is not a finite sum."""


class GaussianMixtureBelief(ExactBelief):
    r"""A mixture of K Gaussians with a common covariance.

    .. math:: p(s) = \sum_k w_k\, N(s; \mu_k, \Sigma)

    The covariance of a Kalman filter does not depend on the observations, so filters with different starts share it.

    Args:
        log_weight: :math:`\log w_k`, normalised, `(*, K)`.
        component_mean: :math:`\mu_k`, `(*, K, D)`.
        covariance: :math:`\Sigma`, `(D, D)` or any shape that broadcasts to `(*, D, D)`.
    """

    def __init__(self, log_weight: Tensor, component_mean: Tensor, covariance: Tensor) -> None:
        self.log_weight = log_weight
        self.component_mean = component_mean
        self.covariance = covariance
        self._scale: Tensor = torch.linalg.cholesky(covariance)
        unit = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
        self._whiten: Tensor = torch.linalg.solve_triangular(self._scale, unit, upper=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """See `Distribution.log_prob`; differentiable in the value."""
        deviation = value.unsqueeze(-2) - self.component_mean  # (..., K, D)
        noise = (self._whiten.unsqueeze(-3) * deviation.unsqueeze(-2)).sum(-1)  # (..., K, D)
        log_det = self._whiten.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)  # (..., 1)
        constant = 0.5 * value.shape[-1] * math.log(2 * math.pi)
        return (self.log_weight - 0.5 * noise.square().sum(-1) + log_det - constant).logsumexp(-1)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """See `Distribution.sample`."""
        component = draw_index(self.log_weight, count, generator)[..., None, None]  # (count, *, 1, 1)
        dim = self.component_mean.shape[-1]
        component = component.expand(*component.shape[:-1], dim)  # (count, *, 1, D)
        means = self.component_mean.expand(count, *self.component_mean.shape)  # (count, *, K, D)
        mean = means.gather(-2, component).squeeze(-2)  # (count, *, D)
        noise = draw_normal(tuple(mean.shape), generator, mean)
        return mean + (self._scale * noise.unsqueeze(-2)).sum(-1)

    @property
    def mean(self) -> Tensor:
        """See `ExactBelief.mean`."""
        return (self.log_weight.exp().unsqueeze(-1) * self.component_mean).sum(-2)

    @property
    def variance(self) -> Tensor:
        """See `ExactBelief.variance`: within the components and between them."""
        apart = (self.component_mean - self.mean.unsqueeze(-2)).square()  # (*, K, D)
        between = (self.log_weight.exp().unsqueeze(-1) * apart).sum(-2)  # (*, D)
        return between + self.covariance.diagonal(dim1=-2, dim2=-1)

    @property
    def entropy(self) -> Tensor | None:
        r"""See `ExactBelief.entropy`: :math:`\frac12 \log\det 2\pi e\Sigma` of one Gaussian; a mixture has none."""
        if self.log_weight.shape[-1] > 1:
            return None
        log_det = self._scale.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = 0.5 * self.covariance.shape[-1] * math.log(2 * math.pi * math.e)
        return (log_det + constant).expand(self.log_weight.shape[:-1])


class GridBelief(ExactBelief):
    r"""A scalar distribution with constant density in G cells of equal width: integrals are finite sums.

    .. math:: p(s) = m_i / \Delta \quad\text{where}\quad |s - c_i| < \Delta / 2, \qquad c_i = c_0 + i \Delta

    Args:
        log_mass: :math:`\log m_i`, normalised, `(*, G)`.
        first: :math:`c_0`, the centre of the first cell, a number or `(*)`.
        width: :math:`\Delta`.
    """

    def __init__(self, log_mass: Tensor, first: Tensor | float, width: float) -> None:
        self.log_mass = log_mass
        self.first = torch.as_tensor(first, dtype=log_mass.dtype, device=log_mass.device)
        self.width = width

    @property
    def centres(self) -> Tensor:
        """c_i of each cell, `(G,)` or `(*, G)`."""
        return self.first.unsqueeze(-1) + self.width * self._index

    def log_prob(self, value: Tensor) -> Tensor:
        """See `Distribution.log_prob`; -inf outside the grid."""
        cells = self.log_mass.shape[-1]
        cell = ((value.squeeze(-1) - self.first) / self.width + 0.5).floor().long()  # (..., *)
        log_mass = self.log_mass.expand(*cell.shape, cells)  # (..., *, G)
        found = log_mass.gather(-1, cell.clamp(0, cells - 1).unsqueeze(-1)).squeeze(-1)  # (..., *)
        return found.where((cell >= 0) & (cell < cells), -torch.inf) - math.log(self.width)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """See `Distribution.sample`: a cell, and a position in the cell."""
        cell = draw_index(self.log_mass, count, generator)  # (count, *)
        offset = torch.rand(cell.shape, generator=generator, dtype=self.log_mass.dtype) - 0.5
        return (self.first + self.width * (cell + offset)).unsqueeze(-1)  # (count, *, 1)

    @property
    def mean(self) -> Tensor:
        """See `ExactBelief.mean`."""
        return (self.first + self.width * (self.log_mass.exp() @ self._index)).unsqueeze(-1)  # (*, 1)

    @property
    def variance(self) -> Tensor:
        r"""See `ExactBelief.variance`: between the cells, and :math:`\Delta^2 / 12` within each."""
        mass = self.log_mass.exp()
        apart = self._index - (mass @ self._index).unsqueeze(-1)  # (*, G)
        return (self.width**2 * ((mass * apart.square()).sum(-1) + 1 / 12)).unsqueeze(-1)  # (*, 1)

    @property
    def entropy(self) -> Tensor:
        """See `ExactBelief.entropy`."""
        return _entropy(self.log_mass) + math.log(self.width)

    @property
    def _index(self) -> Tensor:
        return torch.arange(self.log_mass.shape[-1], dtype=self.log_mass.dtype, device=self.log_mass.device)  # (G,)


class FiniteBelief(ExactBelief):
    """A finite distribution over one-hot vectors.

    Args:
        log_mass: log-probability of each of N values, normalised, `(*, N)`.
    """

    def __init__(self, log_mass: Tensor) -> None:
        self.log_mass = log_mass

    def log_prob(self, value: Tensor) -> Tensor:
        """See `Distribution.log_prob`: log-probability of a one-hot vector."""
        return torch.where(value.bool(), self.log_mass, 0.0).sum(-1)  # not a product: 0 times -inf

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """See `Distribution.sample`: one-hot vectors."""
        index = draw_index(self.log_mass, count, generator)  # (count, *)
        return one_hot(index, self.log_mass.shape[-1]).to(self.log_mass)  # (count, *, N)

    @property
    def mean(self) -> Tensor:
        """See `ExactBelief.mean`: the probabilities."""
        return self.log_mass.exp()

    @property
    def variance(self) -> Tensor:
        """See `ExactBelief.variance`."""
        return self.mean * (1 - self.mean)

    @property
    def entropy(self) -> Tensor:
        """See `ExactBelief.entropy`."""
        return _entropy(self.log_mass)


def _entropy(log_mass: Tensor) -> Tensor:
    entropies: Tensor = torch.special.entr(log_mass.exp())  # 0 log 0 = 0
    return entropies.sum(-1)
