"""Kinds of actions: vectors, one-hot vectors, and concatenations of several one-hot vectors. Does not import torch."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Discrete", "are_one_hot", "as_discrete", "as_plain", "described_sizes", "discrete_of"]
__all__ += ["factor_sizes", "problem_of_choices", "problem_of_discrete", "to_index", "to_one_hot"]

Discrete: TypeAlias = bool | tuple[int, ...]
"""Kind of an action of A numbers: False for a vector in [-1, 1]^A, True for a one-hot vector. Several choices at a time
are a concatenation of one-hot vectors, one per factor; for them, the sizes of the factors, which add up to A."""


def factor_sizes(discrete: Discrete, action_dim: int) -> tuple[int, ...]:
    """Return the sizes of the one-hot vectors in an action; none if it is not discrete."""
    if isinstance(discrete, bool):
        return (action_dim,) if discrete else ()
    return discrete


def discrete_of(sizes: Sequence[int]) -> Discrete:
    """Return the kind of an action whose factors have these sizes: one factor is a one-hot vector."""
    return tuple(map(int, sizes)) if len(sizes) > 1 else len(sizes) == 1


def as_discrete(plain: bool | Sequence[int]) -> Discrete:
    """Return the kind of an action that was read from JSON, which has lists in place of tuples."""
    return plain if isinstance(plain, bool) else tuple(plain)


def as_plain(discrete: Discrete) -> bool | list[int]:
    """Return the kind of an action as a value of JSON, the inverse of `as_discrete`."""
    return discrete if isinstance(discrete, bool) else [*map(int, discrete)]


def problem_of_discrete(discrete: Any, action_dim: int) -> str:
    """Return what is wrong with a kind of action, or an empty string."""
    if isinstance(discrete, bool):
        return ""
    sizes = discrete if isinstance(discrete, tuple) and len(discrete) > 1 else (0,)
    if all(isinstance(size, int | np.integer) and size > 0 for size in sizes) and sum(sizes) == action_dim:
        return ""
    return (
        f"discrete is {discrete}, expected true or false, or the sizes of at least two factors, which add up to "
        f"action_dim, {action_dim}"
    )


def to_one_hot(index: NDArray[Any], sizes: Sequence[int]) -> NDArray[np.float32]:
    """Return actions for the index that each factor takes, integers `(*, F)` to `(*, A)`."""
    columns = zip(np.moveaxis(index, -1, 0), sizes, strict=True)
    return np.concatenate([np.eye(size, dtype=np.float32)[column] for column, size in columns], -1)  # (*, A)


def to_index(action: NDArray[Any], sizes: Sequence[int]) -> NDArray[np.int64]:
    """Return the index that each factor takes in actions, `(*, A)` to int64 `(*, F)`."""
    return np.stack([factor.argmax(-1) for factor in _split(action, sizes)], -1)


def are_one_hot(action: NDArray[Any], sizes: Sequence[int]) -> bool:
    """Return whether every factor of every action is one-hot, `(N, A)`."""
    return bool(np.isin(action, (0, 1)).all()) and all((part.sum(-1) == 1).all() for part in _split(action, sizes))


def problem_of_choices(action: NDArray[Any], discrete: Discrete) -> str:
    """Return which action of an episode, `(T + 1, A)`, is not one-hot, or an empty string. The first has none."""
    sizes = factor_sizes(discrete, action.shape[1])
    if not sizes or are_one_hot(action[1:], sizes):
        return ""
    step = next(step for step in range(1, len(action)) if not are_one_hot(action[step : step + 1], sizes))
    return f"its action at step {step} is {action[step]}, expected {described_sizes(sizes)}"


def described_sizes(sizes: Sequence[int]) -> str:
    """Return what a discrete action is, in words."""
    if len(sizes) == 1:
        return "a one-hot vector"
    return f"one-hot vectors of {', '.join(map(str, sizes[:-1]))} and {sizes[-1]} numbers, one after the other"


def _split(action: NDArray[Any], sizes: Sequence[int]) -> list[NDArray[Any]]:
    return np.split(action, np.cumsum(sizes)[:-1], axis=-1)
