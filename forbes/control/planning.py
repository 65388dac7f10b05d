r"""PlaNet's planner: cross-entropy search over action sequences (Hafner et al., 2019, arXiv 1811.04551, algorithm 2).

.. math:: a^{(j)}_{1:H} \sim N(\mu, \sigma^2) \text{ clipped to } [-1, 1], \qquad
          \mu, \sigma \leftarrow \text{mean and standard deviation of the best } M \text{ of } J
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.models import State, StateSpaceModel

__all__ = ["CrossEntropy", "plan"]


class CrossEntropy(NamedTuple):
    """Settings of the search; the defaults are PlaNet's."""

    horizon: int = 12
    """Agent steps of a plan, H."""
    iterations: int = 10
    """Iterations of the search."""
    candidates: int = 1000
    """Action sequences per iteration, J."""
    best: int = 100
    """Number of elites, M."""

    def maximise(self, objective: Callable[[Tensor], Tensor], mean: Tensor) -> Tensor:
        """Search the action sequences with the highest objective, for B situations at once.

        Args:
            objective: maps actions `(J, B, H, A)` to `(J, B)`.
            mean: initial mean, `(B, H, A)`; the initial standard deviation is 1.

        Returns:
            The final mean, `(B, H, A)`, in [-1, 1].
        """
        std = torch.ones_like(mean)
        for _ in range(self.iterations):
            noise = torch.randn((self.candidates, *mean.shape), dtype=mean.dtype, device=mean.device)
            action = torch.addcmul(mean, std, noise).clamp(-1, 1)  # (J, B, H, A)
            chosen = objective(action).topk(self.best, 0).indices  # (M, B)
            elite = action.gather(0, chosen[..., None, None].expand(-1, *mean.shape))  # (M, B, H, A)
            mean, std = elite.mean(0), (elite.var(0, correction=0) + 1e-6).sqrt()  # 2 x (B, H, A)
        return mean


@torch.no_grad()
def plan(
    model: StateSpaceModel, reward: Callable[[Tensor], Tensor], start: State, action_dim: int, search: CrossEntropy
) -> Tensor:
    """Return the first action of the sequence with the highest sum of predicted rewards.

    Args:
        model: the world model.
        reward: predicts the reward from features, `(*, F)` to `(*)`.
        start: J samples of the belief in each of B situations, `(J B, …)`, from `StateSpaceModel.sample_beliefs`;
            each candidate is evaluated on one, so that the plan is good under the belief and not for one sample.
        action_dim: dimensions of an action, A.
        search: settings of the search.

    Returns:
        An action per situation, `(B, A)`.
    """
    number, rows = search.candidates, len(start.state) // search.candidates

    def objective(action: Tensor) -> Tensor:
        rollout = model.imagine(start, action.flatten(0, 1))
        return reward(rollout.features).sum(-1).view(number, rows)  # (J, B)

    mean = start.state.new_zeros(rows, search.horizon, action_dim)
    return search.maximise(objective, mean)[:, 0]  # (B, A)
