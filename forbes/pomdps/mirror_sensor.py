"""The mirror sensor: only the distance of the state from zero is observed, so the belief has two equal modes."""

import torch
from torch import Tensor

from forbes.errors import ForbesError, require_at_least, require_positive
from forbes.pomdps.base import ExactFilter, Process
from forbes.pomdps.distributions import DiagonalGaussian
from forbes.pomdps.grid import Grid, grid_filter

__all__ = ["MirrorSensor"]

HALF_WIDTH = 6.0
"""Half-width of the grid: six standard deviations of the first state, which is the widest."""


class MirrorSensor(Process):
    r"""An autoregressive state with noisy observations of its absolute value.

    .. math:: s_1 \sim N(0, 1), \qquad s_t = 0.95\, s_{t-1} + N(0, 0.3^2), \qquad o_t = |s_t| + N(0, \sigma^2)

    The process is defined here. The belief is symmetric at every step. A Gaussian with the same moments is 1.16 nats
    per step away from it (forward KL, T = 30). A belief that has lost one mode predicts the observations equally well.

    Args:
        observation_std: standard deviation of the observations, :math:`\sigma`.
        cells: number of cells of the grid on [-6, 6]. With 1601, a cell is a thirteenth of the default :math:`\sigma`
            wide, and log p(o_1:30) has an error of 1e-7 nats; with 401, 1e-5.

    Raises:
        ForbesError: if a cell is wider than :math:`\sigma`, with which log p is off by nats.

    Example:
        >>> process = forbes.MirrorSensor()
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    state_dim = 1
    observation_dim = 1
    action_dim = 0

    def __init__(self, observation_std: float = 0.1, cells: int = 1601) -> None:
        require_positive("MirrorSensor", observation_std=observation_std)
        require_at_least(2, "MirrorSensor", cells=cells)
        self.observation_std = observation_std
        self.grid = Grid.around_kink(-HALF_WIDTH, HALF_WIDTH, cells, kink=0.0)  # |s| has a kink at 0
        if self.grid.width > observation_std:
            raise ForbesError(
                f"MirrorSensor: a cell of its grid is {self.grid.width:g} wide, expected at most observation_std, "
                f"{observation_std:g}, so that beliefs are exact. Set more cells"
            )

    def initial(self, like: Tensor) -> DiagonalGaussian:
        """See `Process.initial`."""
        return DiagonalGaussian(like.new_zeros(1), 1.0)

    def transition(self, state: Tensor, action: Tensor) -> DiagonalGaussian:
        """See `Process.transition`; there is no action."""
        return DiagonalGaussian(0.95 * state, 0.3)

    def emission(self, state: Tensor) -> DiagonalGaussian:
        """See `Process.emission`."""
        return DiagonalGaussian(state.abs(), self.observation_std)

    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """See `Process.policy`; there is no action."""
        return torch.zeros(sequences, steps, 0, dtype=torch.float64)

    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """See `Process.exact_filter`: on the grid."""
        return grid_filter(self, self.grid, *self.checked(observation, action))
