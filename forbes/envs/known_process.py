"""A process whose belief is known exactly, as an environment: a learned agent can be held against the exact belief."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step
from forbes.pomdps import Process
from forbes.pomdps.base import require_positive
from forbes.pomdps.hmm import FiniteProcess

__all__ = ["KnownProcess"]


class KnownProcess(Environment):
    r"""An environment whose hidden state is a `Process`'s.

    .. math:: s_{t+1} \sim p(s \mid s_t, c\,a_t), \qquad o_{t+1} \sim p(o \mid s_{t+1}), \qquad
              r_{t+1} = r(s_t, c\,a_t, s_{t+1})

    c is `Process.action_scale`, so that an agent's actions fill [-1, 1]; those of finite processes are one-hot.
    `Process.exact_filter` of an episode takes its observations and c times its actions.

    Args:
        process: one that has rewards, e.g. `MountainHike`.
        time_limit: steps after which an episode is truncated.
    """

    def __init__(self, process: Process, time_limit: int = 75) -> None:
        require_positive("KnownProcess", time_limit=time_limit)
        self.process, self.time_limit = process, time_limit
        self.observation_shape, self.action_dim = (process.observation_dim,), process.action_dim
        self.discrete = isinstance(process, FiniteProcess)

    def reset(self, seed: int) -> Step:
        """See `Environment.reset`."""
        self._generator = torch.Generator().manual_seed(seed)
        self._time = 0
        like = torch.zeros(1, self.process.action_dim, dtype=torch.float64)
        self._state = self.process.initial(like).sample(1, self._generator).view(1, -1)  # (1, D)
        return Step(self._observe())

    def step(self, action: NDArray[np.float32]) -> Step:
        """See `Environment.step`."""
        taken = self.process.action_scale * torch.from_numpy(action).double().unsqueeze(0)  # (1, A)
        before = self._state
        self._state = self.process.transition(before, taken).sample(1, self._generator).squeeze(0)  # (1, D)
        self._time += 1
        reward = self.process.reward(before, taken, self._state).item()
        terminated = bool(self.process.terminal(self._state))
        return Step(self._observe(), reward, terminated, not terminated and self._time >= self.time_limit)

    def _observe(self) -> NDArray[np.float32]:
        seen = self.process.emission(self._state).sample(1, self._generator)  # (1, 1, O)
        return seen.flatten().float().numpy()  # (O,)

    def describe(self) -> dict[str, Any]:
        """See `Environment.describe`: the process's numbers are those of its attributes."""
        plain = {name: value for name, value in vars(self.process).items() if isinstance(value, int | float | str)}
        made_by = {"torch": torch.__version__}
        return {"task": type(self.process).__name__, "time_limit": self.time_limit, **plain, "made_by": made_by}
