"""The interface of every belief family: a conditional density over the stochastic state s given a context."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, TypeAlias

from torch import Tensor, nn

from forbes.configured import Configurable
from forbes.frozen import frozen
from forbes.performance.time_loop import TimeLoop

__all__ = ["BeliefFamily", "BeliefHead", "Sampler"]

Sampler: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""A context `(B, C)` to a sample s `(B, D)` and log p(s | c) in nats, `(B,)`."""


class BeliefHead(Configurable, nn.Module, ABC):
    r"""A conditional density :math:`p(s \mid c)` over the state given a context.

    The context is the last hidden layer of the network that reads the history, shape `(*, C)`. A family knows neither
    the world model nor the likelihood. To add one, copy `gaussian.py` and write `rsample` and `log_prob`.

    Args:
        state_dim: D, the dimension of s.
        context_dim: C, the dimension of the context.
    """

    reparameterised: ClassVar[bool] = True
    """Whether a sample is a differentiable function of c, whose derivative is its gradient."""

    def __init__(self, state_dim: int, context_dim: int) -> None:
        super().__init__()
        self.state_dim = state_dim
        self.context_dim = context_dim

    @abstractmethod
    def rsample(self, context: Tensor, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """Return reparameterised samples s and their log-density.

        Args:
            context: c, shape `(*, C)`.
            sample_shape: shape of the independent samples per context.

        Returns:
            s, shape `(*sample_shape, *, D)`, and log p(s | c) in nats, shape `(*sample_shape, *)`.
        """

    @abstractmethod
    def log_prob(self, state: Tensor, context: Tensor) -> Tensor:
        """Return log p(s | c) in nats, `(*)`, for a state `(*, D)` and a context `(*, C)`, which broadcast."""

    def path_log_prob(self, state: Tensor, context: Tensor) -> Tensor:
        r"""Return log p(s | c) as a function of s alone: parameters and context receive no gradient.

        At a sample :math:`s = g(\epsilon; c, \theta)` the rest of the gradient,
        :math:`\partial_\theta \log p_\theta(s)` with s fixed, has mean 0 and only adds variance (Roeder et al., 2017,
        arXiv 1703.09194; for flows Vaitl et al., 2022, arXiv 2207.08219). Shapes are those of `log_prob`.
        """
        with frozen(self):
            return self.log_prob(state, context.detach())

    def sampler(self, loop: TimeLoop) -> Sampler:
        """Return the function that samples in every step of a loop: the same as `rsample`, which it is by default.

        A family that is faster when it is prepared for a loop, as a flow is, overrides it (`forbes.performance`).
        """
        return self.rsample

    def kl(self, context: Tensor, prior: "BeliefHead", prior_context: Tensor) -> Tensor | None:
        """Return KL(p(· | c) ‖ prior(· | prior_context)) in nats, `(*)`; None if it has no closed form."""
        return None


BeliefFamily: TypeAlias = Callable[[int, int], BeliefHead]
"""Builds a head from (state_dim, context_dim): a class of this package, or `FlowBelief.configured(layers=3)`."""
