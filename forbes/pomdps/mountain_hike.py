"""The mountain hike of DVRL: a walk in the plane, whose belief is a Gaussian or a mixture of three Gaussians."""

import math
from typing import Literal

import torch
from torch import Tensor

from forbes.errors import require_one_of, require_positive
from forbes.pomdps.base import AffineGaussian, ExactFilter, Process
from forbes.pomdps.beliefs import GaussianMixtureBelief
from forbes.pomdps.distributions import DiagonalGaussian, draw_normal
from forbes.pomdps.kalman import LinearSystem, kalman_filter, smoothing_conditional

__all__ = ["MountainHike", "Start"]

Start = Literal["single", "multi"]

STARTS: dict[Start, list[list[float]]] = {
    "single": [[-0.85, -0.85]],
    "multi": [[-0.85, -0.85], [0.85, -0.85], [0.85, 0.85]],
}
START_STD, TRANSITION_STD, MAX_STEP, BOX_SCALE = 0.1, 0.025, 0.05, 10.0
RIDGES = [  # centre, standard deviations, weight
    ((0.5, 0.5), (0.75, 0.1), 1.0),
    ((0.0, 0.2), (0.1, 0.75), 0.8),
    ((-0.375, -0.5), (0.75, 0.1), 0.55),
]
HEIGHT, SHARPNESS, OUTSIDE, EFFORT = 4.0, 4.0, -6.0, 0.1


class MountainHike(Process):
    r"""A hiker with noisy steps and noisy observations of the position.

    .. math:: s_1 \sim \tfrac1K \sum_k N(m_k, 0.1^2 I), \qquad s_t = s_{t-1} + c(a_{t-1}) + N(0, 0.025^2 I), \qquad
              o_t = 10\,(s_t + N(0, \sigma^2 I)), \qquad c(a) = a \min(1, 0.05 / \lVert a \rVert)

    "single" starts at (-0.85, -0.85) (Igl et al., 2018, arXiv 1806.02426): its belief is that of a Kalman filter.
    "multi" starts at one of three corners (Ma et al., 2020, arXiv 2002.09884, `mode: multi`): its belief is exactly a
    mixture of three Gaussians. Parameters are those of `mountainHike.yaml` in both repositories. Nothing stops the
    hiker at the border. DPFRL's additional noise observation is omitted. An episode has 75 steps there.

    The reward is high on three ridges that lead from the start to the right, where it is highest (`reward`). It carries
    information about the state, which the filter does not use: it is exact for an agent that does not see the reward.

    Actions of `sample` are N(0, 0.05² I), independent over time; three in five exceed the maximal step and are cut.

    Args:
        start: "single" or "multi".
        observation_std: standard deviation of the observations, :math:`\sigma`; 0.1 as in DPFRL's command (the file
            has 0). With 0.1, several starts are distinguished immediately. With 1.5, half of the beliefs have no start
            with more than 95 % after 5 steps, and a fifth after 10 steps.

    Example:
        >>> process = forbes.MountainHike()
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    state_dim = 2
    observation_dim = 2
    action_dim = 2
    action_scale = MAX_STEP

    def __init__(self, start: Start = "single", observation_std: float = 0.1) -> None:
        require_one_of(STARTS, "MountainHike", start=start)
        require_positive("MountainHike", observation_std=observation_std)
        self.start: Start = start
        self.observation_std = observation_std

    def initial(self, like: Tensor) -> GaussianMixtureBelief:
        """See `Process.initial`."""
        means = torch.tensor(STARTS[self.start], dtype=like.dtype, device=like.device)  # (K, 2)
        log_weight = like.new_full((len(means),), -math.log(len(means)))  # (K,)
        return GaussianMixtureBelief(
            log_weight, means, START_STD**2 * torch.eye(2, dtype=like.dtype, device=like.device)
        )

    def transition(self, state: Tensor, action: Tensor) -> DiagonalGaussian:
        """See `Process.transition`."""
        return DiagonalGaussian(state + step_of(action), TRANSITION_STD)

    def emission(self, state: Tensor) -> DiagonalGaussian:
        """See `Process.emission`."""
        return DiagonalGaussian(BOX_SCALE * state, BOX_SCALE * self.observation_std)

    def reward(self, state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        r"""See `Process.reward`: height of the new position (x, y) minus effort, as in both repositories.

        .. math:: r = 4\,(1 - (1 - h)^4) - 4.5 + \tfrac{x + y}{4} - 0.1\,\lVert a \rVert, \qquad
                  h = \max_k \tfrac{w_k}{3}\, N((x, y); m_k, \mathrm{diag}(\sigma_k^2))

        with -6 instead of the height outside of [-1, 1]^2; a is the action before it is cut.
        """
        ridges = []
        for centre, std, weight in RIDGES:
            ridge = DiagonalGaussian(next_state.new_tensor(centre), next_state.new_tensor(std))
            ridges.append(weight / len(RIDGES) * ridge.log_prob(next_state).exp())  # (*)
        height = HEIGHT * (1 - (1 - torch.stack(ridges).amax(0)) ** SHARPNESS)  # (*)
        height = height - (HEIGHT + 0.5) + next_state.sum(-1) / 4
        inside = (next_state.abs() <= 1).all(-1)  # (*)
        effort: Tensor = EFFORT * torch.linalg.vector_norm(action, dim=-1)  # (*)
        return torch.where(inside, height, OUTSIDE) - effort

    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """See `Process.policy`."""
        like = torch.zeros((), dtype=torch.float64)
        return MAX_STEP * draw_normal((sequences, steps, 2), generator, like)

    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """See `Process.exact_filter`: a Kalman filter from each start."""
        observation, action = self.checked(observation, action)
        return kalman_filter(self.system(), observation, step_of(action))

    def exact_smoothing_conditional(self, observation: Tensor, action: Tensor) -> AffineGaussian | None:
        """See `Process.exact_smoothing_conditional`; None for several starts, since it is a mixture at t = 1."""
        observation, action = self.checked(observation, action)
        if self.start == "multi":
            return None
        return smoothing_conditional(self.system(), observation, step_of(action))

    def system(self) -> LinearSystem:
        """Return the matrices of the system."""
        unit = torch.eye(2, dtype=torch.float64)
        return LinearSystem(
            transition=unit,
            transition_covariance=TRANSITION_STD**2 * unit,
            emission=BOX_SCALE * unit,
            emission_covariance=(BOX_SCALE * self.observation_std) ** 2 * unit,
            initial_mean=torch.tensor(STARTS[self.start], dtype=torch.float64),
            initial_covariance=START_STD**2 * unit,
        )


def step_of(action: Tensor) -> Tensor:
    """Return c(a), the action cut to the maximal length of a step, `(*, 2)`."""
    length: Tensor = torch.linalg.vector_norm(action, dim=-1, keepdim=True)
    return action * (MAX_STEP / length.clamp(min=MAX_STEP))
