"""Elementwise mathematics as one kernel each, where an update is recorded for a GPU (`callbacks.CudaGraph`).

An update of an agent is thousands of operations on small tensors, each a kernel that costs its start and a pass over
memory. What lies between two matrix products is elementwise, so the compiler makes one kernel of it, and one of its
gradient. Everywhere else these functions run as they are written: a call of a compiled one costs more than it saves
on a CPU.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch

__all__ = ["fused", "fusing"]

P = ParamSpec("P")
R = TypeVar("R")

_on = False


@contextmanager
def fusing() -> Iterator[None]:
    """Let the functions marked `fused` be compiled."""
    global _on
    before, _on = _on, True
    try:
        with torch._dynamo.config.patch(recompile_limit=64):  # a function meets more shapes than the usual 8
            yield
    finally:
        _on = before


def fused(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a function of tensors without side effects: under `fusing` it is compiled, once for each set of shapes."""

    @wraps(function)
    def either(*args: P.args, **kwargs: P.kwargs) -> R:
        return (_compiled(function) if _on else function)(*args, **kwargs)

    return either


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile at the first call only: a command that never does is not to load the compiler."""
    return torch.compile(function, fullgraph=True, dynamic=False)
