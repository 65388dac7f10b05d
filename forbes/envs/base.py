"""The interface of all environments: reset, step, and the shapes that an agent must know."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.errors import ForbesError, require_at_least
from forbes.factors import Discrete, problem_of_discrete
from forbes.shapes import Observed, Shape, is_shape, printed_by_shape

__all__ = [
    "TIME_LIMIT",
    "Environment",
    "Step",
    "check_environment",
    "check_step",
    "finite_bounds",
    "repeat",
    "require_repeat",
    "scale_action",
]


TIME_LIMIT = 100_000
"""Default number of steps after which an episode is truncated. Atari's, the longest common ones, have 27,000."""


@printed_by_shape
class Step(NamedTuple):
    """The result of an action or a reset."""

    observation: Observed
    """o_t, uint8 `(C, H, W)` for an image, float32 `(O,)` for a vector; of several parts a dict of them by name."""
    reward: float = 0.0
    """r_t, summed over the frames of the step; 0 at a reset."""
    terminated: bool = False
    """Whether the process has ended, so that no reward can follow."""
    truncated: bool = False
    """Whether a time limit has cut the episode, so that rewards would have followed."""
    frames: int = 1
    """Number of simulator frames of the step (env steps). Not counted at a reset."""


class Environment(ABC):
    r"""A process in which an agent acts, episode by episode.

    .. math:: o_1 = \mathrm{reset}(\mathrm{seed}), \qquad (o_{t+1}, r_{t+1}) = \mathrm{step}(a_t)

    To add one, derive from this class: three attributes and two methods (`docs/environments.md` has one of 20 lines).
    The same seed and actions must produce bitwise the same episode, regardless of what was played before.
    """

    observation_shape: Shape
    """Shape of an observation: `(C, H, W)` for images, `(O,)` for vectors; of several parts a dict of them by name."""
    action_dim: int
    """Dimension of an action, A."""
    discrete: Discrete = False
    """False for actions that are any vector in [-1, 1]^A, True for one-hot vectors. For several choices at a time, the
    numbers of options: with `(3, 2)` an action is a one-hot vector of 3 followed by one of 2, and A is 5."""
    action_repeat: int = 1
    """Number of simulator frames for which an action is repeated."""

    @abstractmethod
    def reset(self, seed: int) -> Step:
        """Start the episode of a seed in [0, 2^32), and return its first observation."""

    @abstractmethod
    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`."""

    def named_parts(self) -> dict[str, list[int]]:
        """Return the indices of the dimensions of a vector observation by name, for the view `hide`.

        Of several parts, they are those of the only vector.

        Parts may overlap: `velocities` are those dimensions that depend on velocities.
        """
        return {}

    def describe(self) -> dict[str, Any]:
        """Return all settings that determine the episodes, as plain values, for the record.

        `made_by` has values that may differ between machines, e.g. versions and renderer. All other values must be the
        same for episodes in one store.
        """
        return {"task": type(self).__name__}


def repeat(frame: Callable[[], Step], times: int) -> Step:
    """Call `frame` up to `times` times or until the episode ends. Sum rewards and frames; keep the last observation."""
    total = frame()
    while total.frames < times and not (total.terminated or total.truncated):
        after = frame()
        total = after._replace(reward=total.reward + after.reward, frames=total.frames + after.frames)
    return total


def require_repeat(where: str, action_repeat: int) -> None:
    """Raise a ForbesError unless an action is repeated for at least one frame."""
    require_at_least(1, where, action_repeat=action_repeat)


def finite_bounds(low: NDArray[Any], high: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Replace infinite bounds: a single one is 2 away from the finite bound, two are -1 and 1."""
    below, above = np.isfinite(low), np.isfinite(high)
    return (
        np.where(below, low, np.where(above, high - 2.0, -1.0)),
        np.where(above, high, np.where(below, low + 2.0, 1.0)),
    )


def scale_action(action: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.float64]:
    r"""Map [-1, 1] to the bounds, :math:`l + (a + 1)(h - l) / 2`. Infinite bounds are replaced by `finite_bounds`."""
    low, high = finite_bounds(low, high)
    return low + (action + 1.0) * (high - low) / 2


def check_environment(environment: Environment) -> None:
    """Raise a ForbesError unless an environment defines valid attributes and its task."""
    kind = type(environment).__name__
    shape = getattr(environment, "observation_shape", None)
    if not is_shape(shape):
        raise ForbesError(
            f"{kind}: observation_shape is {shape}, expected (C, H, W), (O,) or a dict of these by part. Set it in the "
            "class"
        )
    for name in ("action_dim", "action_repeat"):
        if not _is_positive_integer(value := getattr(environment, name, None)):
            raise ForbesError(f"{kind}: {name} is {value}, expected an integer above 0. Set it in the class")
    if problem := problem_of_discrete(environment.discrete, environment.action_dim):
        raise ForbesError(f"{kind}: {problem}. Set it in the class")
    if "task" not in (description := environment.describe()):
        raise ForbesError(f"{kind}: describe() returns {description}, expected a task. Add its name")


def _is_positive_integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and bool(value > 0)


def check_step(step: Step, shape: Shape) -> None:
    """Raise a ValueError unless a step is a `Step` of finite values, whose observation has this shape and its dtype."""
    if not isinstance(step, Step):
        raise ValueError(f"it returns a {type(step).__name__}, expected a Step")
    if isinstance(shape, Mapping):
        names = sorted(step.observation) if isinstance(step.observation, Mapping) else "no parts"
        if names != sorted(shape):
            raise ValueError(f"the observation has {names}, expected the parts {sorted(shape)}")
        for part, expected in shape.items():
            _check_array(f"the observation's {part}", step.observation[part], expected)
    else:
        _check_array("the observation", step.observation, shape)
    if not np.isfinite(step.reward):
        raise ValueError(f"the reward is {step.reward}, expected a finite number")


def _check_array(name: str, observation: Any, shape: tuple[int, ...]) -> None:
    dtype = "uint8" if len(shape) == 3 else "float32"
    if not isinstance(observation, np.ndarray):
        raise ValueError(f"{name} is a {type(observation).__name__}, expected {dtype} {shape}")
    if observation.shape != shape or observation.dtype != dtype:
        raise ValueError(f"{name} is {observation.dtype} {observation.shape}, expected {dtype} {shape}")
    if not np.isfinite(observation).all():
        raise ValueError(f"{name} is not finite")
