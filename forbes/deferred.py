r"""Affine maps for a time loop whose weight gradients are computed once, after the loop.

Backpropagating :math:`y_t = W x_t + b` through T steps costs T small products :math:`g_t x_t^\top` and T additions
into the same matrix. Here the steps see a detached W, and each adds its own slice of b repeated over time. The
gradient of that tensor is the stack of all :math:`g_t`, so its backward node can form

.. math:: \partial W = \sum_t g_t x_t^\top = G^\top X, \qquad \partial b = \sum_t g_t

as one product over (T·B). Same numbers up to the order of a sum; `benchmarks/README.md` has the gain.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

__all__ = ["Affine", "Bind", "bind_now", "deferred"]

Affine: TypeAlias = Callable[[Tensor], Tensor]
"""x `(B, in)` to W x + b `(B, out)`."""
Bind: TypeAlias = Callable[[Tensor, Tensor], Affine]
"""Fixes W `(out, in)` and b, `(out,)` or one per step `(T, B, out)`, for a loop."""


def bind_now(weight: Tensor, bias: Tensor) -> Affine:
    """Bind without a loop: plain `linear`, for a bias that does not change with time."""
    return lambda x: linear(x, weight, bias)


def deferred(steps: int, batch: int) -> Bind:
    """Give the `Bind` of a loop over `steps` steps of `(batch, in)` inputs; each affine map is called once a step."""

    def bind(weight: Tensor, bias: Tensor) -> Affine:
        inputs: list[Tensor] = []
        if torch.is_grad_enabled() and not torch.compiler.is_compiling():
            shares = _Deferred.apply(weight, bias.expand(steps, batch, -1), inputs)  # type: ignore[no-untyped-call]
            matrix = weight.detach().T  # (in, out)
        else:  # nothing to defer, or the compiler orders the products itself
            shares, matrix = bias.expand(steps, batch, -1), weight.T  # (T, B, out), (in, out)
        share = iter(shares.unbind(0))

        def affine(x: Tensor) -> Tensor:
            inputs.append(x.detach())
            return torch.addmm(next(share), x, matrix)

        return affine

    return bind


class _Deferred(torch.autograd.Function):
    """Identity on the shares; in the backward pass, adds the gradient of the weight the steps did not compute."""

    @staticmethod
    def forward(ctx: Any, weight: Tensor, shares: Tensor, inputs: list[Tensor]) -> Tensor:
        ctx.inputs = inputs  # filled by the loop, after this call and before the backward pass
        return shares.view_as(shares)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        x = torch.stack(ctx.inputs).flatten(0, 1)  # (T B, in)
        return grad.flatten(0, 1).T @ x, grad, None  # (out, in), (T, B, out)
