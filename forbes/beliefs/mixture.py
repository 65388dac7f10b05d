"""The Gaussian mixture belief (Tschiatschek et al., 2018, arXiv 1805.09281)."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from forbes.beliefs.base import BeliefHead
from forbes.errors import require_at_least
from forbes.shapes import printed_by_shape

__all__ = ["Mixture", "MixtureBelief"]


@printed_by_shape
class Mixture(NamedTuple):
    """M diagonal Gaussians."""

    log_weight: Tensor
    """log w, normalised, `(*, M)`."""
    mean: Tensor
    """μ, `(*, M, D)`."""
    std: Tensor
    """σ, `(*, M, D)`."""

    def log_prob(self, state: Tensor) -> Tensor:
        """Return log p(s) in nats: shape `(*, D)` to `(*)`."""
        log_density = _standard_log_density((state.unsqueeze(-2) - self.mean) / self.std) - self.std.log()  # (*, M, D)
        return (self.log_weight + log_density.sum(-1)).logsumexp(-1)


class MixtureBelief(BeliefHead):
    r"""Mixture of diagonal Gaussians, all of its parameters functions of the context.

    .. math:: p(s \mid c) = \sum_{m=1}^M w_m(c) \prod_d N(s_d; \mu_{md}(c), \sigma_{md}(c)^2), \quad
              w = \mathrm{softmax}(\cdot), \ \sigma = \mathrm{softplus}(\cdot) + \sigma_{min}

    A sample is drawn from a component. Its gradient is the implicit one (Figurnov et al., 2018, arXiv 1805.08498) of

    .. math:: F_d(s_d \mid s_{<d}) = \sum_m r_{md}\, \Phi\!\left(\frac{s_d - \mu_{md}}{\sigma_{md}}\right),
              \qquad r_{md} \propto w_m \prod_{j<d} N(s_j; \mu_{mj}, \sigma_{mj}^2)

    :math:`\partial s / \partial\theta = -(\partial F / \partial s)^{-1}\, \partial F / \partial\theta` depends on s
    alone, so it is the exact pathwise gradient however s was drawn, and unbiased for weights, means and standard
    deviations. If modes are far apart, the gradient of the weights comes from the few samples between them, each
    divided by the small density there.

    Args:
        state_dim: D, the dimension of s.
        context_dim: C, the dimension of the context.
        components: M, the number of Gaussians.
        min_std: smallest standard deviation, as for `GaussianBelief`.

    Raises:
        ForbesError: when M is below 1, or `min_std` below 0.

    Example:
        >>> belief = forbes.MixtureBelief(state_dim=2, context_dim=8, components=3)
        >>> state, log_prob = belief.rsample(torch.zeros(5, 8), sample_shape=(100,))
        >>> state.shape, log_prob.shape
        (torch.Size([100, 5, 2]), torch.Size([100, 5]))
    """

    def __init__(self, state_dim: int, context_dim: int, components: int = 5, min_std: float = 0.1) -> None:
        super().__init__(state_dim, context_dim)
        require_at_least(1, "MixtureBelief", components=components)
        require_at_least(0, "MixtureBelief", min_std=min_std)
        self.components, self.min_std = components, min_std
        self.parameters_of = nn.Linear(context_dim, components * (1 + 2 * state_dim))

    def mixture(self, context: Tensor) -> Mixture:
        """Return p(s | c) for contexts `(*, C)`."""
        size, shape = self.components * self.state_dim, (self.components, self.state_dim)
        logits, mean, raw_std = self.parameters_of(context).split((self.components, size, size), -1)
        std = softplus(raw_std.unflatten(-1, shape)) + self.min_std  # (*, M, D)
        return Mixture(logits.log_softmax(-1), mean.unflatten(-1, shape), std)  # (*, M), (*, M, D), (*, M, D)

    def rsample(self, context: Tensor, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """See `BeliefHead.rsample`."""
        return _draw(self.mixture(context), sample_shape)

    def log_prob(self, state: Tensor, context: Tensor) -> Tensor:
        """See `BeliefHead.log_prob`."""
        return self.mixture(context).log_prob(state)


def _standard_log_density(noise: Tensor) -> Tensor:
    """Return log N(ε; 0, 1) elementwise."""
    return -0.5 * (noise.square() + math.log(2 * math.pi))


def _draw(mixture: Mixture, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
    """Return samples, `(*sample_shape, *, D)`, and their log-density in nats, `(*sample_shape, *)`."""
    with torch.no_grad():
        log_weight = mixture.log_weight.expand(*sample_shape, *mixture.log_weight.shape)  # (*sample_shape, *, M)
        gumbel = -torch.rand_like(log_weight).log().neg().log()  # (*sample_shape, *, M)
        component = (log_weight + gumbel).argmax(-1)[..., None, None]  # (*sample_shape, *, 1, 1)
        mean, std = (
            values.expand(*sample_shape, *values.shape).take_along_dim(component, -2).squeeze(-2)
            for values in (mixture.mean, mixture.std)
        )  # (*sample_shape, *, D)
        state = torch.addcmul(mean, std, torch.randn_like(std))
    state = _reparameterised(mixture, state)
    return state, mixture.log_prob(state)


def _reparameterised(mixture: Mixture, state: Tensor) -> Tensor:
    r"""Return the same state with the gradient :math:`-J^{-1}\, \partial F / \partial\theta`, J lower triangular.

    .. math:: J_{dj} = \frac{\partial F_d}{\partial s_j} = -\sum_m r_{md} (\Phi_{md} - F_d) \frac{s_j - \mu_{mj}}
              {\sigma_{mj}^2} \ (j < d), \qquad J_{dd} = p(s_d \mid s_{<d})
    """
    noise_of = (state.unsqueeze(-2) - mixture.mean) / mixture.std  # (*, M, D)
    log_density = _standard_log_density(noise_of) - mixture.std.log()  # (*, M, D)
    log_weight = mixture.log_weight.expand(log_density.shape[:-1]).unsqueeze(-1)  # (*, M, 1)
    responsibility = torch.cat((log_weight, log_density[..., :-1]), -1).cumsum(-1).softmax(-2)  # r, (*, M, D)
    with torch.no_grad():
        above = (responsibility * torch.erfc(noise_of / math.sqrt(2))).sum(-2, keepdim=True) < 1  # F > 1/2, (*, 1, D)
        side = torch.where(above, 1.0, -1.0).to(state.dtype)  # (*, 1, D)
    # F is taken from its smaller tail, which keeps the precision: Φ below the median, Φ - 1 above it.
    tails = -0.5 * side * torch.erfc(side * noise_of / math.sqrt(2))  # (*, M, D)
    cdf_tail = (responsibility * tails).sum(-2)  # F or F - 1, (*, D)
    with torch.no_grad():
        density = (responsibility * log_density.exp()).sum(-2)  # (*, D)
        # In a gap between modes, F is constant up to rounding; the floor bounds the gradient there.
        density = density.clamp(min=torch.finfo(density.dtype).eps)
        below = (responsibility * (tails - cdf_tail.unsqueeze(-2))).mT @ (-noise_of / mixture.std)  # (*, D, D)
        jacobian = below.tril(-1) + density.diag_embed()  # (*, D, D)
    change: Tensor = torch.linalg.solve_triangular(
        jacobian, (cdf_tail - cdf_tail.detach()).unsqueeze(-1), upper=False
    )  # (*, D, 1)
    return state - change.squeeze(-1)
