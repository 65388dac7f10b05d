"""The Gaussian belief of the RSSM (Hafner et al., 2019, arXiv 1811.04551)."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from forbes.beliefs.base import BeliefHead, Sampler
from forbes.errors import require_at_least
from forbes.performance.fusion import fused
from forbes.performance.time_loop import TimeLoop

__all__ = ["GaussianBelief", "standard_normal_log_prob"]


def standard_normal_log_prob(noise: Tensor) -> Tensor:
    """Return log N(ε; 0, I) in nats, summed over the last dimension: shape `(*, D)` to `(*)`."""
    return -0.5 * (noise.square().sum(-1) + noise.shape[-1] * math.log(2 * math.pi))


class GaussianBelief(BeliefHead):
    r"""Diagonal Gaussian whose mean and standard deviation are functions of the context.

    .. math:: p(s \mid c) = N(s; \mu(c), \mathrm{diag}\,\sigma(c)^2), \ \sigma = \mathrm{softplus}(\cdot) + \sigma_{min}

    Args:
        state_dim: D, the dimension of s.
        context_dim: C, the dimension of the context.
        min_std: smallest standard deviation; 0.1 as in PlaNet and Dreamer.

    Raises:
        ForbesError: when `min_std` is below 0.

    Example:
        >>> belief = forbes.GaussianBelief(state_dim=2, context_dim=8)
        >>> state, log_prob = belief.rsample(torch.zeros(5, 8), sample_shape=(100,))
        >>> state.shape, log_prob.shape
        (torch.Size([100, 5, 2]), torch.Size([100, 5]))
    """

    def __init__(self, state_dim: int, context_dim: int, min_std: float = 0.1) -> None:
        super().__init__(state_dim, context_dim)
        require_at_least(0, type(self).__name__, min_std=min_std)
        self.min_std = min_std
        self.parameters_of = nn.Linear(context_dim, 2 * state_dim)

    def moments(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, each `(*, D)`."""
        return _moments(self.parameters_of(context), self.min_std)

    def rsample(self, context: Tensor, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """See `BeliefHead.rsample`."""
        return _place(self.parameters_of(context), self._noise(context, sample_shape), self.min_std)

    def sampler(self, loop: TimeLoop) -> Sampler:
        """See `BeliefHead.sampler`: the gradient of the weights is deferred, which saves 2 % of an update."""
        place = loop.linear(self.parameters_of.weight, self.parameters_of.bias, _place)
        return lambda context: place(context, self._noise(context), self.min_std)

    def log_prob(self, state: Tensor, context: Tensor) -> Tensor:
        """See `BeliefHead.log_prob`."""
        mean, std = self.moments(context)
        return standard_normal_log_prob((state - mean) / std) - std.log().sum(-1)

    def kl(self, context: Tensor, prior: BeliefHead, prior_context: Tensor) -> Tensor | None:
        r"""See `BeliefHead.kl`; the closed form exists if both are Gaussian.

        .. math:: \sum_d \log\frac{\sigma_p}{\sigma_q} + \frac{\sigma_q^2 + (\mu_q-\mu_p)^2}{2\sigma_p^2} - \frac12
        """
        if not isinstance(prior, GaussianBelief):
            return None
        (mean, std), (prior_mean, prior_std) = self.moments(context), prior.moments(prior_context)
        ratio, shift = std / prior_std, (mean - prior_mean) / prior_std
        return (0.5 * (ratio.square() + shift.square() - 1) - ratio.log()).sum(-1)

    def _noise(self, context: Tensor, sample_shape: tuple[int, ...] = ()) -> Tensor:
        """Return ε ~ N(0, I), `(*sample_shape, *, D)`."""
        shape = (*sample_shape, *context.shape[:-1], self.state_dim)
        return torch.randn(*shape, dtype=context.dtype, device=context.device)  # (*sample_shape, *, D)


def _moments(parameters: Tensor, min_std: float) -> tuple[Tensor, Tensor]:
    mean, raw_std = parameters.chunk(2, -1)  # 2 x (*, D)
    return mean, softplus(raw_std) + min_std


@fused
def _place(parameters: Tensor, noise: Tensor, min_std: float) -> tuple[Tensor, Tensor]:
    """Return s = μ + σ ε, `(*, D)`, and its log-density in nats, `(*)`."""
    mean, std = _moments(parameters, min_std)
    return torch.addcmul(mean, std, noise), standard_normal_log_prob(noise) - std.log().sum(-1)
