"""The univariate nonstationary growth model, a classic of non-linear filtering: its belief has two unequal modes."""

import math

import torch
from torch import Tensor

from forbes.errors import require_at_least
from forbes.pomdps.base import ExactFilter, Process
from forbes.pomdps.distributions import DiagonalGaussian
from forbes.pomdps.grid import Grid, grid_filter

__all__ = ["Ungm"]


class Ungm(Process):
    r"""A state that jumps between two wells, with noisy observations of its square.

    .. math:: s_1 \sim N(0, 4), \qquad s_t = \frac{s_{t-1}}{2} + \frac{25\, s_{t-1}}{1 + s_{t-1}^2} + 8\, a_{t-1} +
              N(0, 10), \qquad o_t = \frac{s_t^2}{20} + N(0, 1)

    Gordon, Salmond and Smith (1993, IEE Proceedings F 140); the first variance is that of the library *particles*
    (`Gordon_etal`). The time dependence of the model is its action, :math:`a_t = \cos(1.2\,(t-1))`, so that the
    transition is the same at every step. At 61 % of the steps (T = 30) more than 5 % of the belief is on the less
    likely side of zero.

    Args:
        cells: number of cells of the grid on [-45, 45]. With 901, log p(o_1:30) has an error of 1e-9 nats; with 451,
            4e-4.

    Example:
        >>> process = forbes.Ungm()
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    state_dim = 1
    observation_dim = 1
    action_dim = 1

    def __init__(self, cells: int = 901) -> None:
        require_at_least(2, "Ungm", cells=cells)
        self.grid = Grid(-45.0, 45.0, cells)

    def initial(self, like: Tensor) -> DiagonalGaussian:
        """See `Process.initial`."""
        return DiagonalGaussian(like.new_zeros(1), 2.0)

    def transition(self, state: Tensor, action: Tensor) -> DiagonalGaussian:
        """See `Process.transition`."""
        return DiagonalGaussian(state / 2 + 25 * state / (1 + state.square()) + 8 * action, math.sqrt(10))

    def emission(self, state: Tensor) -> DiagonalGaussian:
        """See `Process.emission`."""
        return DiagonalGaussian(state.square() / 20, 1.0)

    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """See `Process.policy`: the cosine, the same for all sequences."""
        time = torch.arange(steps, dtype=torch.float64)  # t - 1
        return (1.2 * time).cos().view(1, -1, 1).expand(sequences, -1, -1)  # (B, steps, 1)

    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """See `Process.exact_filter`: on the grid."""
        return grid_filter(self, self.grid, *self.checked(observation, action))
