"""Elementwise mathematics as one kernel each, where an update is recorded for a GPU (`callbacks.CudaGraph`).

An update of an agent is thousands of operations on small tensors, each a kernel that costs its start and a pass over
memory. What lies between two matrix products is elementwise, so the compiler makes one kernel of it, and one of its
gradient. Everywhere else these functions run as they are written: a call of a compiled one costs more than it saves
on a CPU.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import Any, ParamSpec, TypeAlias, TypeVar

import torch
from torch import Tensor

__all__ = ["Elementwise", "after_affine", "fused", "fusing", "keep"]

P = ParamSpec("P")
R = TypeVar("R")
Elementwise: TypeAlias = Callable[..., Any]
"""A function of a tensor, and of whatever else; a function of a module, so that it is compiled once."""

_on = False


@contextmanager
def fusing() -> Iterator[None]:
    """Let the functions marked `fused` be compiled."""
    global _on
    before, _on = _on, True
    try:
        with torch._dynamo.config.patch(recompile_limit=256):  # a function meets more shapes than the usual 8
            yield
    finally:
        _on = before


def fused(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a function of tensors without side effects: under `fusing` it is compiled, once for each set of shapes."""

    @wraps(function)
    def either(*args: P.args, **kwargs: P.kwargs) -> R:
        return (_compiled(function) if _on else function)(*args, **kwargs)

    return either


def keep(x: Tensor) -> Tensor:
    """Return x: nothing follows."""
    return x


def after_affine(then: Elementwise, share: Tensor, x: Tensor, matrix: Tensor, *more: Any) -> Any:
    """Return then(x W + b, ...), with b as `(B, out)`.

    Under `fusing`, adding b is part of what follows: `addmm` would copy it first, a kernel as long as the product.
    """
    if not _on or then is keep:
        return then(torch.addmm(share, x, matrix), *more)
    return _compiled(_after_sum(then))(x @ matrix, share, *more)


@cache
def _after_sum(then: Elementwise) -> Elementwise:
    inner = getattr(then, "__wrapped__", then)  # of a `fused` function, itself

    def after_sum(product: Tensor, share: Tensor, *more: Any) -> Any:
        return inner(product + share, *more)

    return after_sum


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile at the first call only: a command that never does is not to load the compiler."""
    return torch.compile(function, fullgraph=True, dynamic=False)
