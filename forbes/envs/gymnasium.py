"""Environments of Gymnasium (Towers et al., 2024, arXiv 2407.17032), by id."""

import difflib
import warnings
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step, repeat, require_repeat
from forbes.envs.images import RENDERED_SIZE, to_image
from forbes.envs.views import VELOCITIES
from forbes.errors import ForbesError, require_at_least
from forbes.factors import discrete_of
from forbes.shapes import Observed, map_parts, part_name

__all__ = ["Gymnasium"]

_VELOCITY = {"CartPole": [1, 3], "Pendulum": [2], "Acrobot": [4, 5], "MountainCar": [1], "MountainCarContinuous": [1]}
"""Indices of the velocities in the environments whose vectors have no names, by the environment's name."""
_MOVING = ("qvel", "cvel", "ten_velocity", "cfrc_ext")
"""Those of the parts of MuJoCo's environments that depend on velocities: contact forces do, too."""


class Gymnasium(Environment):
    """An environment of Gymnasium, e.g. `Pendulum-v1`, or `package:Name-v0` for a package that registers it.

    Observations are images, uint8 `(C, H, W)`, if the space is a uint8 Box of 0 to 255 with 1, 3 or 4 channels or
    without a channel dimension. Otherwise they are float32 vectors: values of a Box, one-hot vectors for a Discrete or
    MultiDiscrete, and the concatenated parts of a Dict or Tuple. Integers of a Box with two bounds are scaled to
    [0, 1], and text is ignored. A Dict with an image among other entries has an observation of several parts, one for
    each entry. With `pixels` the observation is the rendered image.

    Actions of a Box are scaled from [-1, 1] to its bounds (`scale_action`), with equal intervals for integers. Actions
    of a Discrete are one-hot; those of a MultiDiscrete or MultiBinary have a one-hot vector for each of their choices.
    Gymnasium's `TimeLimit` is a truncation.

    Args:
        task: id of the environment.
        pixels: observe rendered images, uint8 `(3, size, size)`. The environment chooses the renderer; those of MuJoCo
            read MUJOCO_GL, for which `forbes doctor` reports the working values.
        action_repeat: number of Gymnasium steps per action. Their rewards are summed.
        size: side of the images in pixels. Default: 64 with `pixels`, otherwise the original size.
        part: entry of a Dict observation to use, e.g. `image` in MiniGrid. Default: all entries.
        parts: entries of a Dict observation to use, each as a part of its own.

    Raises:
        ForbesError: for an unknown id, an unsupported space of actions or observations, a size without images, or if
            gymnasium is not installed.

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
        parts: list[str] | None = None,
    ) -> None:
        require_repeat(task, action_repeat)
        self.task, self.pixels, self.action_repeat = task, pixels, action_repeat
        self.options = {name: value for name, value in (("part", part), ("parts", parts)) if value is not None}
        self.size = RENDERED_SIZE if pixels and size is None else size
        if self.size is not None:
            require_at_least(1, task, size=self.size)
        self._environment = _make(task, pixels)
        from forbes.envs import gymnasium_spaces

        self._spaces = gymnasium_spaces
        self._seen: dict[str, Any] = {}  # spaces of the entries of a Dict that are observed
        self._space = self._environment.observation_space
        if not pixels:
            self._seen = _entries(task, self._space, part, parts)
            for space in self._seen.values() or [self._space]:
                self._spaces.require_observations(task, space)
            if size is not None and not any(map(self._spaces.is_image, self._seen.values() or [self._space])):
                raise ForbesError(f"{task}: size is for images, and it observes none. Set pixels, or leave size out")
        self._single = parts is None and len(self._seen) == 1
        self._actions: Any = self._environment.action_space
        self._spaces.require_actions(task, self._actions)
        sizes = self._spaces.factors(self._actions)
        self.discrete = discrete_of(sizes)
        self.action_dim = sum(sizes) or int(np.prod(self._actions.shape))
        self.observation_shape = map_parts(np.shape, self.reset(0).observation)

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed."""
        observation, _ = self._environment.reset(seed=seed)
        return Step(self._observe(observation))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`."""
        taken = self._spaces.to_action(self._actions, action)
        last: Any = None

        def frame() -> Step:
            nonlocal last
            last, reward, terminated, truncated, _ = self._environment.step(taken)
            return Step(np.empty(0), float(reward), bool(terminated), bool(truncated))

        return repeat(frame, self.action_repeat)._replace(observation=self._observe(last))

    def _observe(self, observation: Any) -> Observed:
        if self.pixels:
            return to_image(self._environment.render(), self.size)
        if not self._seen:
            return self._array(self._space, observation)
        seen = {part_name(name): self._array(space, observation[name]) for name, space in self._seen.items()}
        return next(iter(seen.values())) if self._single else seen

    def _array(self, space: Any, value: Any) -> NDArray[Any]:
        if self._spaces.is_image(space):
            return to_image(value, self.size)
        return self._spaces.flatten(space, value)

    def named_parts(self) -> dict[str, list[int]]:
        """Return the entries of a Dict or the parts of a MuJoCo environment by name, and `velocities` where known."""
        if not isinstance(self.observation_shape, tuple) or len(self.observation_shape) != 1:
            return {}
        [space] = self._seen.values() or [self._space]
        sizes = self._spaces.sizes(space)
        structure: dict[str, int] = getattr(self._environment.unwrapped, "observation_structure", {})
        sizes |= {name: size for name, size in structure.items() if name != "skipped_qpos"}
        parts: dict[str, list[int]] = {}
        for name, size in sizes.items():
            first = sum(map(len, parts.values()))
            parts[name] = list(range(first, first + size))
        velocities = [index for name in _MOVING for index in parts.get(name, [])]
        velocities += _VELOCITY.get(self._environment.spec.id.rpartition("-")[0], [])
        return {name: part for name, part in (parts | {VELOCITIES: velocities}).items() if part}

    def describe(self) -> dict[str, Any]:
        """Return task, kind of observation and version."""
        made_by = {"gymnasium": version("gymnasium")}
        return {"task": f"gymnasium:{self.task}", "pixels": self.pixels, **self.options, "made_by": made_by}


def _make(task: str, pixels: bool) -> Any:
    """Make an environment, with rendering if `pixels` is set; not every constructor has a `render_mode`."""
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        raise ForbesError(f"{task}: gymnasium is not installed. pip install 'forbes[gym]'") from error
    blind = f"{task}: it does not render images (render_mode rgb_array), as needed for pixels. Do not set pixels"
    options: dict[str, Any] = {"render_mode": "rgb_array"} if pixels else {}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*is not in the possible render_modes.*")  # an error is raised below
            environment: Any = gymnasium.make(task, **options)
    except TypeError as error:
        if "'render_mode'" not in str(error):
            raise
        raise ForbesError(blind) from error
    except gymnasium.error.DependencyNotInstalled as error:
        raise ForbesError(f"{task}: {error}") from error
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        name = task.rpartition(":")[2]
        if name in gymnasium.registry and isinstance(error, ModuleNotFoundError):
            raise ForbesError(f"{task}: needs the module {error.name}, which is not installed. Install it") from error
        near = difflib.get_close_matches(name, gymnasium.registry, n=3)
        hint = f". Did you mean {' or '.join(near)}?" if near else f" ({error}). Use a registered id"
        raise ForbesError(f"{task}: gymnasium has no such environment{hint}") from error
    if pixels and "rgb_array" not in environment.metadata.get("render_modes", []):
        raise ForbesError(blind)
    return environment


def _entries(task: str, space: Any, part: str | None, parts: list[str] | None) -> dict[str, Any]:
    """Return the spaces of the entries of a Dict to observe, by name; nothing if the whole space is one observation."""
    from forbes.envs.gymnasium_spaces import is_image, is_text

    inside = getattr(space, "spaces", None)
    entries: dict[str, Any] = dict(inside) if isinstance(inside, dict) else {}
    if part is None and parts is None:
        shown = {name: entry for name, entry in entries.items() if not is_text(entry)}
        return shown if any(map(is_image, shown.values())) else {}
    if part is not None and parts is not None:
        raise ForbesError(f"{task}: part and parts are both set, expected one of them. Remove one")
    option, names = ("part", [part]) if parts is None else ("parts", parts)
    for name in names or [""]:
        if name not in entries:
            expected = ", ".join(map(str, entries)) or "a Dict"
            raise ForbesError(f"{task}: {option} is {name!r}, expected one of {expected}. Choose one")
    return {str(name): entries[str(name)] for name in names}
