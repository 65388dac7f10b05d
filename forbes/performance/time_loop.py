r"""A time loop whose weight gradients are computed once, after the loop.

Backpropagating :math:`y_t = W x_t + b` through T steps costs T small products :math:`g_t x_t^\top` and T additions
into the same matrix. Here the steps see a detached W, and each adds its own slice of b repeated over time. The
gradient of that tensor is the stack of all :math:`g_t`, so its backward node can form

.. math:: \partial W = \sum_t g_t x_t^\top = G^\top X, \qquad \partial b = \sum_t g_t

as one product over (T·B). Same numbers up to the order of a sum; `benchmarks/README.md` has the gain.
"""

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

from forbes.performance.fusion import Elementwise, after_affine, keep

__all__ = ["Affine", "Bind", "TimeLoop", "bind_now"]

Affine: TypeAlias = Callable[..., Any]
"""x `(*, in)` and what else `then` takes, to then(W x + b, ...); W x + b is `(*, out)`."""


class Bind(Protocol):
    """Fixes W `(out, in)` and b `(out,)` of an affine map, and what elementwise function follows it."""

    def __call__(self, weight: Tensor, bias: Tensor, then: Elementwise = keep) -> Affine:
        """Bind."""


def bind_now(weight: Tensor, bias: Tensor, then: Elementwise = keep) -> Affine:
    """Bind outside a time loop."""
    return lambda x, *more: then(linear(x, weight, bias), *more)


class TimeLoop:
    """A loop over `steps` steps of `(batch, in)` inputs, to which affine maps are bound."""

    def __init__(self, steps: int, batch: int) -> None:
        self.steps, self.batch = steps, batch

    def affine(self, weight: Tensor, bias: Tensor, then: Elementwise = keep) -> Affine:
        """See `Bind`: a map that is called once a step; b may also be one per step, `(T, B, out)`."""
        shares = bias.expand(self.steps, self.batch, -1)  # (T, B, out)
        learns = torch.is_grad_enabled() and (weight.requires_grad or bias.requires_grad)
        if not learns or torch.compiler.is_compiling():
            # Nothing to defer, or the compiler orders the products itself.
            share, transposed = iter(shares.unbind(0)), weight.T  # (in, out)
            return lambda x, *more: after_affine(then, next(share), x, transposed, *more)
        inputs: list[Tensor] = []
        share = iter(_Shares.apply(weight, shares, inputs).unbind(0))  # type: ignore[no-untyped-call]
        matrix = weight.detach().T  # (in, out)

        def affine(x: Tensor, *more: Any) -> Any:
            inputs.append(x.detach())
            return after_affine(then, next(share), x, matrix, *more)

        return affine


class _Shares(torch.autograd.Function):
    """Identity on b repeated over time; in the backward pass, forms the gradient that the steps left out."""

    @staticmethod
    def forward(ctx: Any, weight: Tensor, shares: Tensor, inputs: list[Tensor]) -> Tensor:
        ctx.inputs = inputs  # filled by the loop, after this call and before the backward pass
        return shares.view_as(shares)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        return grad.flatten(0, 1).T @ torch.cat(ctx.inputs), grad, None  # (out, in), (T, B, out)
