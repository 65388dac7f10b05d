"""A scalar linear-Gaussian process, for which everything has a closed form."""

import math

import torch
from torch import Tensor

from forbes.errors import require_positive
from forbes.pomdps.base import AffineGaussian, ExactFilter, Process
from forbes.pomdps.distributions import DiagonalGaussian
from forbes.pomdps.kalman import LinearSystem, kalman_filter, smoothing_conditional

__all__ = ["LinearGaussian"]


class LinearGaussian(Process):
    r"""A random walk with noisy observations.

    .. math:: s_1 \sim N(0, P_1), \qquad s_t = F s_{t-1} + N(0, Q), \qquad o_t = s_t + N(0, R)

    The defaults, all 1, are those of FIVO's Gaussian HMM (Maddison et al., 2017, arXiv 1705.09279; `ghmm.py` of its
    code). `LinearGaussian(transition_variance=0.1)` is harder: an observation has little information compared to the
    belief, and an ELBO-trained belief is far too narrow. `LinearGaussian(0.9, 0.3, 0.5)` is stationary in the long run.

    Args:
        transition: coefficient F.
        transition_variance: variance of the transition, Q.
        observation_variance: variance of the observations, R.
        initial_variance: variance of the first state, :math:`P_1`.

    Example:
        >>> process = forbes.LinearGaussian(observation_variance=0.5)
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    state_dim = 1
    observation_dim = 1
    action_dim = 0

    def __init__(
        self,
        transition: float = 1.0,
        transition_variance: float = 1.0,
        observation_variance: float = 1.0,
        initial_variance: float = 1.0,
    ) -> None:
        require_positive(
            "LinearGaussian",
            transition_variance=transition_variance,
            observation_variance=observation_variance,
            initial_variance=initial_variance,
        )
        self.coefficient = transition
        self.transition_variance = transition_variance
        self.observation_variance = observation_variance
        self.initial_variance = initial_variance

    def initial(self, like: Tensor) -> DiagonalGaussian:
        """See `Process.initial`."""
        return DiagonalGaussian(like.new_zeros(1), math.sqrt(self.initial_variance))

    def transition(self, state: Tensor, action: Tensor) -> DiagonalGaussian:
        """See `Process.transition`; there is no action."""
        return DiagonalGaussian(self.coefficient * state, math.sqrt(self.transition_variance))

    def emission(self, state: Tensor) -> DiagonalGaussian:
        """See `Process.emission`."""
        return DiagonalGaussian(state, math.sqrt(self.observation_variance))

    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """See `Process.policy`; there is no action."""
        return torch.zeros(sequences, steps, 0, dtype=torch.float64)

    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """See `Process.exact_filter`: a Kalman filter."""
        observation, _ = self.checked(observation, action)
        return kalman_filter(self.system(), observation, torch.zeros_like(observation))

    def exact_smoothing_conditional(self, observation: Tensor, action: Tensor) -> AffineGaussian:
        """See `Process.exact_smoothing_conditional`."""
        observation, _ = self.checked(observation, action)
        return smoothing_conditional(self.system(), observation, torch.zeros_like(observation))

    def system(self) -> LinearSystem:
        """Return the matrices of the system."""
        one = torch.ones(1, 1, dtype=torch.float64)
        return LinearSystem(
            transition=self.coefficient * one,
            transition_covariance=self.transition_variance * one,
            emission=one,
            emission_covariance=self.observation_variance * one,
            initial_mean=0 * one,
            initial_covariance=self.initial_variance * one,
        )
