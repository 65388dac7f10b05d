"""Environments of processes with a known belief, so that an agent can be compared with the exact belief."""

from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forbes.envs.base import Environment, Step
from forbes.errors import ForbesError, require_one_of, require_positive
from forbes.pomdps import ExactBelief, FiniteBelief, GaussianMixtureBelief, Process
from forbes.pomdps.hmm import FiniteProcess

__all__ = ["KnownProcess", "Shown"]

Shown = Literal["observation", "exact_belief", "nothing"]


class KnownProcess(Environment):
    r"""An environment whose hidden state is that of a `Process`.

    .. math:: s_{t+1} \sim p(s \mid s_t, c\,a_t), \qquad o_{t+1} \sim p(o \mid s_{t+1}), \qquad
              r_{t+1} = r(s_t, c\,a_t, s_{t+1})

    c is `Process.action_scale`, so that actions of an agent are in [-1, 1]; those of finite processes are one-hot. To
    filter an episode with `Process.exact_filter`, pass its observations and c times its actions.

    Two values of `shows` are references for an agent that filters. "exact_belief" replaces o_t by the parameters of
    p(s_t | o_1:t, a_1:t-1): probabilities of finite states, or weights, means and standard deviations of a Gaussian
    mixture. The return is then that of perfect filtering. "nothing" replaces o_t by zeros. The return is then that
    without any observation.

    Args:
        process: process with rewards, e.g. `MountainHike`.
        time_limit: number of steps after which an episode is truncated.
        shows: "observation", "exact_belief" or "nothing".

    Raises:
        ForbesError: if `shows` has another value, or the exact belief has no such parameters.
    """

    def __init__(self, process: Process, time_limit: int = 75, shows: Shown = "observation") -> None:
        require_positive("KnownProcess", time_limit=time_limit)
        require_one_of(get_args(Shown), "KnownProcess", shows=shows)
        self.process, self.time_limit = process, time_limit
        self.shows: Shown = shows
        self.observation_shape, self.action_dim = (process.observation_dim,), process.action_dim
        self.discrete = isinstance(process, FiniteProcess)
        if shows == "exact_belief":
            self.observation_shape = self.reset(0).observation.shape

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed."""
        self._generator = torch.Generator().manual_seed(seed)
        self._time = 0
        like = torch.zeros(1, self.process.action_dim, dtype=torch.float64)
        self._state = self.process.initial(like).sample(1, self._generator).view(1, -1)  # (1, D)
        self._seen: list[Tensor] = []
        self._taken = [like]
        return Step(self._observe())

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`."""
        taken = self.process.action_scale * torch.from_numpy(action).double().unsqueeze(0)  # (1, A)
        before = self._state
        self._taken.append(taken)
        self._state = self.process.transition(before, taken).sample(1, self._generator).squeeze(0)  # (1, D)
        self._time += 1
        reward = self.process.reward(before, taken, self._state).item()
        terminated = bool(self.process.terminal(self._state))
        return Step(self._observe(), reward, terminated, not terminated and self._time >= self.time_limit)

    def _observe(self) -> NDArray[np.float32]:
        seen = self.process.emission(self._state).sample(1, self._generator)  # (1, 1, O)
        if self.shows == "nothing":
            seen = torch.zeros_like(seen)
        if self.shows != "exact_belief":
            return seen.flatten().float().numpy()  # (O,)
        self._seen.append(seen.squeeze(0))
        history = (torch.stack(values, 1) for values in (self._seen, self._taken))  # (1, t, O), (1, t, A)
        return _parameters(self.process.exact_filter(*history).belief).float().numpy()  # (O,)

    def describe(self) -> dict[str, Any]:
        """Return task, settings and the plain attributes of the process."""
        plain = {name: value for name, value in vars(self.process).items() if isinstance(value, int | float | str)}
        made_by = {"torch": torch.__version__}
        known = {"time_limit": self.time_limit, "shows": self.shows}
        return {"task": type(self.process).__name__, **known, **plain, "made_by": made_by}


def _parameters(belief: ExactBelief) -> Tensor:
    """Return the parameters of the last belief of a sequence, `(O,)`."""
    if isinstance(belief, FiniteBelief):
        return belief.mean[0, -1]  # (S,)
    if not isinstance(belief, GaussianMixtureBelief):
        raise ForbesError(
            f"shows: the exact belief is a {type(belief).__name__} with too many parameters, expected finite states or "
            "Gaussians. Choose observation"
        )
    std = belief.covariance[-1].diagonal().sqrt()  # (D,)
    return torch.cat((belief.log_weight[0, -1].exp(), belief.component_mean[0, -1].flatten(), std))  # (K + K D + D,)
