"""Convert between the spaces of Gymnasium and the arrays of an `Environment`. Imports gymnasium."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from forbes.envs.base import finite_bounds, scale_action
from forbes.envs.images import CHANNELS
from forbes.errors import ForbesError
from forbes.factors import to_index

__all__ = ["factors", "first_option", "flatten", "is_image", "is_text", "require_actions", "require_observations"]
__all__ += ["sizes", "to_action"]

_FLAT = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_REGISTER = "Wrap and register it in a module of your own, and use: gymnasium:MODULE:ID"


def is_image(space: Any) -> bool:
    """Return whether a space is a uint8 Box of 0 to 255, `(H, W)` or with 1, 3 or 4 channels, first or last."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or len(space.shape) not in (2, 3):
        return False
    channels = len(space.shape) == 2 or space.shape[0] in CHANNELS or space.shape[-1] in CHANNELS
    return channels and bool((space.low == 0).all() and (space.high == 255).all())


def flatten(space: Any, value: Any) -> NDArray[np.float32]:
    """Return a value of a space as a vector, float32 `(O,)`.

    The result is that of `gymnasium.spaces.flatten`, except that integers of a Box with two bounds are scaled to
    [0, 1], and text is ignored.
    """
    if isinstance(space, spaces.Dict):
        return np.concatenate([flatten(part, value[name]) for name, part in space.spaces.items()])
    if isinstance(space, spaces.Tuple):
        return np.concatenate([flatten(part, entry) for part, entry in zip(space.spaces, value, strict=True)])
    if is_text(space):
        return np.empty(0, np.float32)
    flat = np.asarray(spaces.flatten(space, value))  # (O,)
    if isinstance(space, spaces.Box) and flat.dtype.kind in "iu":
        low, high = _bounds(space)
        bounded = np.isfinite(high - low)
        flat = np.where(bounded, (flat - low) / np.where(bounded & (high > low), high - low, 1), flat)
    return flat.astype(np.float32)


def sizes(space: Any) -> dict[str, int]:
    """Return how many numbers `flatten` makes of each entry of a Dict; of another space, nothing."""
    entries = space.spaces if isinstance(space, spaces.Dict) else {}
    return {
        str(name): sum(0 if is_text(leaf) else spaces.flatdim(leaf) for leaf in _parts(entry))
        for name, entry in entries.items()
    }


def require_observations(task: str, space: Any) -> None:
    """Raise a ForbesError unless `flatten` supports every part of a space."""
    for part in _parts(space):
        if not isinstance(part, _FLAT) and not is_text(part):
            raise ForbesError(
                f"{task}: its observations have a {type(part).__name__}, expected images, or numbers in Box, Discrete, "
                f"MultiDiscrete, MultiBinary, Tuple and Dict. {_REGISTER}"
            )
    if all(is_text(part) for part in _parts(space)):
        raise ForbesError(f"{task}: its observations are text, expected numbers or images. {_REGISTER}")


def require_actions(task: str, space: Any, remedy: str = _REGISTER) -> None:
    """Raise a ForbesError unless `to_action` supports a space."""
    if not isinstance(space, _FLAT):
        kind = type(space).__name__
        raise ForbesError(
            f"{task}: its actions are a {kind}, expected a Box, Discrete, MultiDiscrete or MultiBinary. {remedy}"
        )


def factors(space: Any) -> tuple[int, ...]:
    """Return the number of options of each choice in an action; none for a Box."""
    if isinstance(space, spaces.Discrete):
        return (int(space.n),)
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(map(int, space.nvec.ravel()))
    return (2,) * int(np.prod(space.shape)) if isinstance(space, spaces.MultiBinary) else ()


def first_option(space: Any) -> Any:
    """Return the number that stands for the first option of each choice, in the shape of an action."""
    return getattr(space, "start", 0)


def to_action(space: Any, action: NDArray[np.float32]) -> Any:
    r"""Return the member of a space for an action, float32 `(A,)` in [-1, 1] or of a one-hot vector for each choice.

    Real values of a Box are scaled by `scale_action`. Integers from l to h have equal intervals of [-1, 1]:

    .. math:: \min(h, \lfloor l + (a + 1)(h - l + 1) / 2 \rfloor)
    """
    if sizes := factors(space):
        return (to_index(action, sizes).reshape(space.shape) + first_option(space)).astype(space.dtype)  # (*space)
    low, high = finite_bounds(*_bounds(space))
    if space.dtype.kind == "f":
        scaled = scale_action(action, low, high)
    else:
        scaled = np.minimum(np.floor(scale_action(action, low, high + 1)), high)
    return scaled.reshape(space.shape).astype(space.dtype)


def _bounds(space: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return low and high of a Box, `(O,)`. A missing bound is infinite, also for integers."""
    low = np.where(space.bounded_below, space.low, -np.inf).ravel().astype(np.float64)
    high = np.where(space.bounded_above, space.high, np.inf).ravel().astype(np.float64)
    return low, high


def is_text(space: Any) -> bool:
    """Return whether a space holds text. Packages define their own classes for it, e.g. MiniGrid for its mission."""
    return space.dtype is not None and space.dtype.kind == "U"


def _parts(space: Any) -> list[Any]:
    """Return the leaves of nested Dicts and Tuples."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        members = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return [part for member in members for part in _parts(member)]
    return [space]
