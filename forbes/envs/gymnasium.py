"""Any single environment of Gymnasium (Towers et al., 2024, arXiv 2407.17032), by its id."""

import difflib
import warnings
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step, repeat, require_repeat
from forbes.errors import ForbesError

__all__ = ["Gymnasium"]


class Gymnasium(Environment):
    """An environment of Gymnasium: `Pendulum-v1`, or `package:Name-v0` of a package that registers its own.

    Observations are images, uint8 `(C, H, W)`, where the space is a uint8 Box of 0 to 255 with 1, 3 or 4 channels or
    none; else float32 vectors: numbers of a Box, one-hot of a Discrete or a MultiDiscrete, and one after the other the
    parts of a Dict or a Tuple. Whole numbers between two bounds are scaled to [0, 1], and text is left out. With
    `pixels` the observation is what the environment draws.

    Actions of a Box are scaled from [-1, 1] to its bounds (`scale_action`), its whole numbers with equal shares; those
    of a Discrete are one-hot. Its `TimeLimit` is a truncation.

    Args:
        task: the id.
        pixels: observe what it draws, uint8 `(3, size, size)`. The environment itself chooses what draws: those of
            MuJoCo read MUJOCO_GL, for which `forbes doctor` says what works here.
        action_repeat: steps of Gymnasium for which an action is held; their rewards add up.
        size: pixels a side of images; by default 64 with `pixels`, else as they are.
        part: name of the entry of a Dict that is observed, e.g. `image` of MiniGrid; by default all are.

    Raises:
        ForbesError: for an unknown id, a space of actions or observations that is none of these, or where gymnasium is
            missing.

    Example:
        >>> environment = forbes.Gymnasium("CartPole-v1")
        >>> environment.reset(seed=0).observation.shape
        (4,)
        >>> environment.step(torch.tensor([1.0, 0.0]).numpy()).reward
        1.0
    """

    def __init__(
        self,
        task: str,
        pixels: bool = False,
        action_repeat: int = 1,
        size: int | None = None,
        part: str | None = None,
    ) -> None:
        require_repeat(task, action_repeat)
        self.task, self.pixels, self.action_repeat, self.part = task, pixels, action_repeat, part
        self.size = size or 64 if pixels else size
        self._environment = _make(task, pixels)
        from forbes.envs import gymnasium_spaces

        self._spaces = gymnasium_spaces
        self._seen = _entry(task, self._environment.observation_space, part)
        if not pixels:
            self._spaces.require_observations(task, self._seen)
        self._actions: Any = self._environment.action_space
        self._spaces.require_actions(task, self._actions)
        self.discrete = type(self._actions).__name__ == "Discrete"
        self.action_dim = int(self._actions.n) if self.discrete else int(np.prod(self._actions.shape))
        self.observation_shape = self.reset(0).observation.shape

    def reset(self, seed: int) -> Step:
        """See `Environment.reset`."""
        observation, _ = self._environment.reset(seed=seed)
        return Step(self._observe(observation))

    def step(self, action: NDArray[np.float32]) -> Step:
        """See `Environment.step`."""
        taken = self._spaces.to_action(self._actions, action)
        last: Any = None

        def frame() -> Step:
            nonlocal last
            last, reward, terminated, truncated, _ = self._environment.step(taken)
            return Step(np.empty(0), float(reward), bool(terminated), bool(truncated))

        return repeat(frame, self.action_repeat)._replace(observation=self._observe(last))

    def _observe(self, observation: Any) -> NDArray[Any]:
        if self.pixels:
            return self._spaces.to_image(self._environment.render(), self.size)
        if self.part is not None:
            observation = observation[self.part]
        if self._spaces.is_image(self._seen):
            return self._spaces.to_image(observation, self.size)
        return self._spaces.flatten(self._seen, observation)

    def describe(self) -> dict[str, Any]:
        """See `Environment.describe`."""
        part = {} if self.part is None else {"part": self.part}
        made_by = {"gymnasium": version("gymnasium")}
        return {"task": f"gymnasium:{self.task}", "pixels": self.pixels, **part, "made_by": made_by}


def _make(task: str, pixels: bool) -> Any:
    """Make an environment, one that draws with `pixels`; not every constructor has a `render_mode`."""
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        raise ForbesError(f"{task}: gymnasium is not installed. pip install 'forbes[gym]'") from error
    blind = f"{task}: it draws no pictures (render_mode rgb_array), expected them for pixels. Leave pixels out"
    options: dict[str, Any] = {"render_mode": "rgb_array"} if pixels else {}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*is not in the possible render_modes.*")  # said below, as an error
            environment: Any = gymnasium.make(task, **options)
    except TypeError as error:
        if "'render_mode'" not in str(error):
            raise
        raise ForbesError(blind) from error
    except gymnasium.error.DependencyNotInstalled as error:
        raise ForbesError(f"{task}: {error}") from error
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        name = task.rpartition(":")[2]
        near = difflib.get_close_matches(name, gymnasium.registry, n=3)
        hint = f". Did you mean {' or '.join(near)}?" if near else f" ({error}). Name one that is registered"
        raise ForbesError(f"{task}: gymnasium has no such environment{hint}") from error
    if pixels and "rgb_array" not in environment.metadata.get("render_modes", []):
        raise ForbesError(blind)
    return environment


def _entry(task: str, space: Any, part: str | None) -> Any:
    """Return the space of an entry of a Dict, or the whole."""
    if part is None:
        return space
    names = list(getattr(space, "spaces", []))
    if part not in names:
        raise ForbesError(
            f"{task}: part is {part!r}, expected one of {', '.join(map(str, names)) or 'a Dict'}. Choose it"
        )
    return space.spaces[part]
