"""The flow belief of FORBES (Chen et al., 2022, arXiv 2205.11051, equations of §3.1)."""

from functools import partial
from typing import Literal

import torch
from torch import Tensor

from forbes.beliefs.base import BeliefHead, Sampler
from forbes.beliefs.coupling import AffineCoupling, ConditionalFlow
from forbes.beliefs.gaussian import GaussianBelief
from forbes.beliefs.splines import SplineCoupling
from forbes.errors import require_one_of
from forbes.performance.time_loop import TimeLoop

__all__ = ["FlowBelief"]


class FlowBelief(BeliefHead):
    r"""A Gaussian pushed through a conditional flow.

    .. math:: s = f(s_0; c), \quad s_0 \sim N(\mu(c), \sigma(c)^2), \qquad
              \log p(s \mid c) = \log N(s_0; \mu, \sigma^2) - \log\left|\det \partial f / \partial s_0\right|

    At initialisation f is the identity, so the belief equals `GaussianBelief`.

    Args:
        state_dim: D, the dimension of s; at least 2 with affine couplings.
        context_dim: C, the dimension of the context.
        layers: K, the number of coupling layers; 5 for DeepMind Control, 3 for digit strokes (paper, appendix).
        width: width of each coupling network; the paper does not give it.
        min_std: smallest standard deviation of the base, as for `GaussianBelief`.
        coupling: "affine" is the paper's; "spline" can also split a one-dimensional state into several modes (Durkan et
            al., 2019).
        bins: number of bins per spline; 8 as in Durkan et al.

    Raises:
        ForbesError: when a size is below its minimum, `min_std` below 0, or `coupling` another word.

    Example:
        >>> belief = forbes.FlowBelief(state_dim=2, context_dim=8, layers=3)
        >>> state, log_prob = belief.rsample(torch.zeros(5, 8), sample_shape=(100,))
        >>> state.shape, log_prob.shape
        (torch.Size([100, 5, 2]), torch.Size([100, 5]))
    """

    def __init__(
        self,
        state_dim: int,
        context_dim: int,
        layers: int = 5,
        width: int = 64,
        min_std: float = 0.1,
        coupling: Literal["affine", "spline"] = "affine",
        bins: int = 8,
    ) -> None:
        super().__init__(state_dim, context_dim)
        require_one_of(("affine", "spline"), "FlowBelief", coupling=coupling)
        self.base = GaussianBelief(state_dim, context_dim, min_std)
        with torch.random.fork_rng(devices=[]):  # the same seed gives a Gaussian belief the same other weights
            family = AffineCoupling if coupling == "affine" else partial(SplineCoupling, bins=bins)
            self.flow = ConditionalFlow(state_dim, context_dim, layers, width, family)

    def rsample(self, context: Tensor, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """See `BeliefHead.rsample`."""
        base, log_prob = self.base.rsample(context, sample_shape)
        state, log_det = self.flow(base, context)
        return state, log_prob - log_det

    def log_prob(self, state: Tensor, context: Tensor) -> Tensor:
        """See `BeliefHead.log_prob`."""
        base, log_det = self.flow.inverse(state, context)
        return self.base.log_prob(base, context) - log_det

    def sampler(self, loop: TimeLoop) -> Sampler:
        """See `BeliefHead.sampler`: the flow's layers are merged for the loop."""
        sample_base, generate = self.base.sampler(loop), self.flow.prepare(loop)

        def sample(context: Tensor) -> tuple[Tensor, Tensor]:
            base, log_prob = sample_base(context)
            state, log_det = generate(base, context)
            return state, log_prob - log_det

        return sample
