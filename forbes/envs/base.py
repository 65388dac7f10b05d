"""The interface of every environment: reset, step, and the numbers an agent must know."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.errors import ForbesError, require_at_least
from forbes.shapes import printed_by_shape

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
"""Steps after which an episode that has not ended is truncated. Atari's, the longest common ones, have 27,000."""


@printed_by_shape
class Step(NamedTuple):
    """What an environment answers to an action, or to a reset."""

    observation: NDArray[Any]
    """o_t, uint8 `(C, H, W)` for an image, float32 `(O,)` for a vector."""
    reward: float = 0.0
    """r_t, summed over the frames of the step; 0 at a reset."""
    terminated: bool = False
    """The process has ended: no reward can follow."""
    truncated: bool = False
    """A time limit has cut the episode: rewards would have followed."""
    frames: int = 1
    """Frames of the simulator that the step took: env steps. Not counted at a reset."""


class Environment(ABC):
    r"""A process that an agent acts in, one episode after the other.

    .. math:: o_1 = \mathrm{reset}(\mathrm{seed}), \qquad (o_{t+1}, r_{t+1}) = \mathrm{step}(a_t)

    To add one, derive from this class: three numbers and two methods (`docs/environments.md` has one of 20 lines).
    The same seed and actions give the same episode, bit for bit, whatever was played before.
    """

    observation_shape: tuple[int, ...]
    """`(C, H, W)` of images, `(O,)` of vectors."""
    action_dim: int
    """A."""
    discrete: bool = False
    """Whether an action is one of A, as a one-hot vector; else it is any vector in [-1, 1]^A."""
    action_repeat: int = 1
    """Frames of the simulator for which an action is held."""

    @abstractmethod
    def reset(self, seed: int) -> Step:
        """Begin the episode that belongs to a seed in [0, 2^32), and give its first observation."""

    @abstractmethod
    def step(self, action: NDArray[np.float32]) -> Step:
        """Act, float32 `(A,)`."""

    def describe(self) -> dict[str, Any]:
        """Return what determines the episodes, as plain values, for the record.

        `made_by` holds what another machine may have otherwise: versions, renderer. The rest must be the same for
        episodes to be mixed.
        """
        return {"task": type(self).__name__}


def repeat(frame: Callable[[], Step], times: int) -> Step:
    """Call for `times` frames, or until the episode ends: rewards and frames add up, the rest is the last frame's."""
    total = frame()
    while total.frames < times and not (total.terminated or total.truncated):
        after = frame()
        total = after._replace(reward=total.reward + after.reward, frames=total.frames + after.frames)
    return total


def require_repeat(where: str, action_repeat: int) -> None:
    """Raise a ForbesError unless an action is held for at least one frame."""
    require_at_least(1, where, action_repeat=action_repeat)


def finite_bounds(low: NDArray[Any], high: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bounds with each infinite one 2 away from the finite one, or -1 and 1 where both are infinite."""
    below, above = np.isfinite(low), np.isfinite(high)
    return (
        np.where(below, low, np.where(above, high - 2.0, -1.0)),
        np.where(above, high, np.where(below, low + 2.0, 1.0)),
    )


def scale_action(action: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.float64]:
    r"""Map [-1, 1] to the bounds :math:`l + (a + 1)(h - l) / 2`, infinite ones as in `finite_bounds`: scale 1."""
    low, high = finite_bounds(low, high)
    return low + (action + 1.0) * (high - low) / 2


def check_environment(environment: Environment) -> None:
    """Raise a ForbesError unless an environment says its numbers, of the right kind, and its task."""
    kind = type(environment).__name__
    shape = getattr(environment, "observation_shape", None)
    if not isinstance(shape, tuple | list) or len(shape) not in (1, 3) or not all(_counts(size) for size in shape):
        raise ForbesError(f"{kind}: observation_shape is {shape}, expected (C, H, W) or (O,). Give the class one")
    for name in ("action_dim", "action_repeat"):
        if not _counts(value := getattr(environment, name, None)):
            raise ForbesError(f"{kind}: {name} is {value}, expected a whole number above 0. Give the class one")
    if not isinstance(environment.discrete, bool):
        raise ForbesError(f"{kind}: discrete is {environment.discrete}, expected true or false. Give the class one")
    if "task" not in (description := environment.describe()):
        raise ForbesError(f"{kind}: describe() gives {description}, expected a task among it. Add its name")


def _counts(value: Any) -> bool:
    return isinstance(value, int | np.integer) and bool(value > 0)


def check_step(step: Step, shape: tuple[int, ...]) -> None:
    """Raise a ValueError unless it is a Step whose observation has its shape and dtype, and all numbers are finite."""
    if not isinstance(step, Step):
        raise ValueError(f"it gives a {type(step).__name__}, expected a Step")
    observation, dtype = step.observation, "uint8" if len(shape) == 3 else "float32"
    if observation.shape != shape or observation.dtype != dtype:
        found = f"{observation.dtype} {observation.shape}"
        raise ValueError(f"the observation is {found}, expected {dtype} {shape}")
    if not np.isfinite(observation).all():
        raise ValueError("the observation is not finite")
    if not np.isfinite(step.reward):
        raise ValueError(f"the reward is {step.reward}, expected a finite number")
