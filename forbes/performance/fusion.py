"""Elementwise mathematics as one kernel each, where an update is recorded for a GPU (`callbacks.CudaGraph`).

An update of an agent is thousands of operations on small tensors, each a kernel that costs its start and a pass over
memory. What lies between two matrix products is elementwise, so the compiler makes one kernel of it, and one of its
gradient. Everywhere else these functions run as they are written: a call of a compiled one costs more than it saves
on a CPU.

How it works: a module-level function is marked `fused`. Inside `with fusing():` a flag is on, and each marked function
is compiled at its first call, once per set of shapes; outside, the flag is off and the function itself is called.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import Any, ParamSpec, TypeAlias, TypeVar

import torch
from torch import Tensor

__all__ = ["Elementwise", "activated", "fused", "fusing", "identity"]

P = ParamSpec("P")
R = TypeVar("R")
Elementwise: TypeAlias = Callable[..., Any]
"""A function of a tensor and further arguments, defined at module level so that it is compiled only once."""

_on = False


@contextmanager
def fusing() -> Iterator[None]:
    """Compile the functions marked `fused` while this context is active."""
    global _on
    before, _on = _on, True
    try:
        with torch._dynamo.config.patch(recompile_limit=256):  # a function meets more shapes than the default of 8
            yield
    finally:
        _on = before


def fused(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a function of tensors without side effects: under `fusing` it is compiled, once for each set of shapes."""

    @wraps(function)  # keeps the function itself as `__wrapped__`, for `activated`
    def compiled_or_plain(*args: P.args, **kwargs: P.kwargs) -> R:
        return (_compiled(function) if _on else function)(*args, **kwargs)

    return compiled_or_plain


def identity(x: Tensor) -> Tensor:
    """Return x: the activation of a linear map that has none."""
    return x


def activated(activation: Elementwise, x: Tensor, weight_t: Tensor, bias_t: Tensor, *more: Any) -> Any:
    """Return activation(x Wᵀ + b, ...): x `(B, in)`, Wᵀ `(in, out)`, and b `(B, out)`, one bias per row.

    Under `fusing`, adding b is part of the activation's kernel: `addmm` would first copy b, which takes as long as the
    product.
    """
    if not _on or activation is identity:
        return activation(torch.addmm(bias_t, x, weight_t), *more)
    return _compiled(_after_sum(activation))(x @ weight_t, bias_t, *more)


@cache
def _after_sum(activation: Elementwise) -> Elementwise:
    plain = getattr(activation, "__wrapped__", activation)  # the function that `fused` marked

    def after_sum(product: Tensor, bias_t: Tensor, *more: Any) -> Any:
        return plain(product + bias_t, *more)

    return after_sum


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call, so that a command that needs none does not load the compiler."""
    return torch.compile(function, fullgraph=True, dynamic=False)
