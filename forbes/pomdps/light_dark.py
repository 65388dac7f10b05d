"""The light-dark problem in one dimension: observations are more precise near the light."""

import math

import torch
from torch import Tensor

from forbes.errors import require_positive
from forbes.pomdps.base import ExactFilter, Process
from forbes.pomdps.beliefs import GridBelief
from forbes.pomdps.distributions import DiagonalGaussian, PointMass
from forbes.pomdps.grid import Grid, require_inside

__all__ = ["LightDark"]


class LightDark(Process):
    r"""A walker with known steps and an unknown start.

    .. math:: s_1 \sim N(2, 3^2), \qquad s_t = s_{t-1} + a_{t-1}, \qquad o_t \sim N(s_t, \sigma(s_t)^2), \quad
              \sigma(s) = |s - 5| / \sqrt2 + 0.01

    This is `LightDark1D` of POMDPModels.jl without the action that ends an episode. An observation far from the light
    at 5 rules out that the walker is near it, so the belief has a notch there and two modes around it.

    As the steps are known, the belief is over the start, and moves with the walker:

    .. math:: p(s_t = x \mid o_{1:t}) \propto p(s_1 = y) \prod_{i \le t} p(o_i \mid y + a_1 + \dots + a_{i-1}),
              \qquad y = x - a_1 - \dots - a_{t-1}

    Actions of `sample` are steps of 1 to the left or to the right, equally likely and independent over time.

    Args:
        cells_per_step: number of cells per step of the grid of starts on [-25, 29], nine standard deviations to each
            side. With 250, log p(o_1:30) has a mean error of 4e-5 nats: none for most sequences, and up to 6e-3 for a
            walk observed to pass the light.

    Example:
        >>> process = forbes.LightDark(cells_per_step=20)
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    state_dim = 1
    observation_dim = 1
    action_dim = 1

    def __init__(self, cells_per_step: int = 250) -> None:
        require_positive("LightDark", cells_per_step=cells_per_step)
        # Steps are integers, so the kink of σ(s) is always at the same position within a cell.
        self.grid = Grid.around_kink(-25.0, 29.0, 54 * cells_per_step + 1, kink=5.0)

    def initial(self, like: Tensor) -> DiagonalGaussian:
        """See `Process.initial`."""
        return DiagonalGaussian(like.new_full((1,), 2.0), 3.0)

    def transition(self, state: Tensor, action: Tensor) -> PointMass:
        """See `Process.transition`: deterministic, so without a density."""
        return PointMass(state + action)

    def emission(self, state: Tensor) -> DiagonalGaussian:
        """See `Process.emission`."""
        return DiagonalGaussian(state, (state - 5).abs() / math.sqrt(2) + 0.01)

    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """See `Process.policy`."""
        right = torch.randint(2, (sequences, steps, 1), generator=generator, device=generator.device)
        return 2 * right.cpu().double() - 1

    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """See `Process.exact_filter`: on the grid of starts."""
        observation, action = self.checked(observation, action)
        centres = self.grid.centres.unsqueeze(-1)  # (G, 1)
        moved = action.cumsum(1)  # (B, T, 1)
        seen = self.log_observation(observation.unsqueeze(2), moved.unsqueeze(2) + centres)  # (B, T, G)
        start = self.log_initial(centres) + math.log(self.grid.width)  # (G,)
        log_joint = start + seen.cumsum(1)  # log p(o_1:t, start), (B, T, G)
        log_evidence = log_joint.logsumexp(-1)  # log p(o_1:t), (B, T)
        log_mass = log_joint - log_evidence.unsqueeze(-1)
        belief = GridBelief(log_mass, self.grid.first + moved.squeeze(-1), self.grid.width)
        require_inside("LightDark", belief)
        return ExactFilter(belief, log_evidence.diff(dim=1, prepend=torch.zeros_like(log_evidence[:, :1])))  # (B, T)
