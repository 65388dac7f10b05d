"""Any single environment of Gymnasium (Towers et al., 2024, arXiv 2407.17032), by its id."""

import difflib
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step, repeat, require_repeat, scale_action
from forbes.errors import ForbesError

__all__ = ["Gymnasium"]


class Gymnasium(Environment):
    """An environment of Gymnasium: `Pendulum-v1`, or `package:Name-v0` of a package that registers its own.

    Its observations are flattened to float32 vectors (`gymnasium.spaces.flatten`: numbers of a Box, one-hot of a
    Discrete), or, with `pixels`, are what it draws, in `size` by `size` pixels. Actions of a Box are scaled from
    [-1, 1] to its bounds, those of a Discrete are one-hot. Its `TimeLimit` is a truncation.

    Args:
        task: the id.
        pixels: observe uint8 `(3, size, size)`. The environment itself chooses what draws: those of MuJoCo read
            MUJOCO_GL, for which `forbes doctor` says what works here.
        action_repeat: steps of Gymnasium for which an action is held; their rewards add up.
        size: pixels a side.

    Raises:
        ForbesError: for an unknown id, an action that is neither a Box nor a Discrete, or where gymnasium is missing.
    """

    def __init__(self, task: str, pixels: bool = False, action_repeat: int = 1, size: int = 64) -> None:
        require_repeat(task, action_repeat)
        self.task, self.pixels, self.action_repeat, self.size = task, pixels, action_repeat, size
        self._environment = _make(task, "rgb_array" if pixels else None)
        space = self._environment.action_space
        kind = type(space).__name__
        if kind not in ("Box", "Discrete"):
            raise ForbesError(f"{task}: its actions are a {kind}, expected a Box or a Discrete. Wrap it")
        self.discrete = kind == "Discrete"
        self._actions: Any = space
        self.action_dim = int(self._actions.n) if self.discrete else int(np.prod(self._actions.shape))
        self.observation_shape = (3, size, size) if pixels else self.reset(0).observation.shape

    def reset(self, seed: int) -> Step:
        """See `Environment.reset`."""
        observation, _ = self._environment.reset(seed=seed)
        return Step(self._observe(observation))

    def step(self, action: NDArray[np.float32]) -> Step:
        """See `Environment.step`."""
        taken = self._translate(action)
        last: Any = None

        def frame() -> Step:
            nonlocal last
            last, reward, terminated, truncated, _ = self._environment.step(taken)
            return Step(np.empty(0), float(reward), bool(terminated), bool(truncated))

        return repeat(frame, self.action_repeat)._replace(observation=self._observe(last))

    def _translate(self, action: NDArray[np.float32]) -> Any:
        if self.discrete:
            return self._actions.start + action.argmax()
        low, high = self._actions.low.ravel(), self._actions.high.ravel()
        return scale_action(action, low, high).reshape(self._actions.shape).astype(self._actions.dtype)

    def _observe(self, observation: Any) -> NDArray[Any]:
        if self.pixels:
            return _resize(self._environment.render(), self.size)
        from gymnasium.spaces import flatten

        return np.asarray(flatten(self._environment.observation_space, observation), np.float32)

    def describe(self) -> dict[str, Any]:
        """See `Environment.describe`."""
        made_by = {"gymnasium": version("gymnasium")}
        return {"task": f"gymnasium:{self.task}", "pixels": self.pixels, "made_by": made_by}


def _make(task: str, render_mode: str | None) -> Any:
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        raise ForbesError(f"{task}: gymnasium is not installed. pip install 'forbes[gym]'") from error
    try:
        return gymnasium.make(task, render_mode=render_mode)
    except (gymnasium.error.UnregisteredEnv, ModuleNotFoundError) as error:
        near = difflib.get_close_matches(task, gymnasium.registry, n=3)
        hint = f". Did you mean {' or '.join(near)}?" if near else f" ({error}). Name one that is registered"
        raise ForbesError(f"{task}: gymnasium has no such environment{hint}") from error
    except gymnasium.error.DependencyNotInstalled as error:
        raise ForbesError(f"{task}: {error}") from error


def _resize(frame: Any, size: int) -> NDArray[np.uint8]:
    """Give a frame `(H, W, 3)` as uint8 `(3, size, size)`, each pixel the mean of those it covers."""
    from PIL import Image

    small = Image.fromarray(frame).resize((size, size), Image.Resampling.BOX)
    return np.ascontiguousarray(np.asarray(small).transpose(2, 0, 1))  # (3, H, W)
