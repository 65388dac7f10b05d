r"""A time loop whose linear maps are prepared before it, so that its steps do less.

Two things are hoisted out of the loop. A bias that is known for all steps, such as the term of the embeddings in a
network's first layer, is one matrix product over (T·B) before it. The gradient of a weight is one product after it:
backpropagating :math:`y_t = W x_t + b_t` through T steps costs T small products :math:`g_t x_t^\top` and T additions
into the same matrix. Here the steps see a detached W, and each adds its own slice :math:`b_t` of one tensor. The
gradient of that tensor is the stack of all :math:`g_t`, so its backward node can form

.. math:: \partial W = \sum_t g_t x_t^\top = G^\top X, \qquad \partial b = \sum_t g_t

The numbers are the same up to the order of a sum; `benchmarks/README.md` has the gain.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from forbes.errors import ForbesError
from forbes.performance.fusion import Elementwise, activated, identity

__all__ = ["BoundLinear", "TimeLoop"]

BoundLinear: TypeAlias = Callable[..., Any]
"""A linear map of one loop: x `(B, in)` and what else its activation takes, to activation(W x + b_t, ...)."""


class TimeLoop:
    """A loop over T steps, to which linear maps are bound before it starts.

    Args:
        steps: T.
        batch: B, the rows of every step.
    """

    def __init__(self, steps: int, batch: int) -> None:
        self.steps, self.batch = steps, batch

    def linear(self, weight: Tensor, bias: Tensor, activation: Elementwise = identity) -> BoundLinear:
        """Bind a linear map, to be called once in each step, in order.

        Args:
            weight: W, `(out, in)`.
            bias: b, `(out,)`; or one per step and row, b_t, `(T, B, out)`.
            activation: elementwise function of W x + b_t, `(B, out)`, and of what else the map is called with.

        Returns:
            The map of x, `(B, in)`. It raises a `ForbesError` when it is called more than T times.
        """
        biases = bias.expand(self.steps, self.batch, -1)  # (T, B, out)
        learns = torch.is_grad_enabled() and (weight.requires_grad or bias.requires_grad)
        if not learns or torch.compiler.is_compiling():
            # There is no gradient to defer, or the compiler orders the products itself.
            bias_at, weight_t = iter(biases.unbind(0)), weight.T  # (in, out)
            return lambda x, *more: activated(activation, x, weight_t, self._next(bias_at), *more)
        inputs: list[Tensor] = []
        deferred: Tensor = _DeferredGradient.apply(weight, biases, inputs)  # type: ignore[no-untyped-call]
        bias_at, weight_t = iter(deferred.unbind(0)), weight.detach().T  # (in, out)

        def linear(x: Tensor, *more: Any) -> Any:
            inputs.append(x.detach())
            return activated(activation, x, weight_t, self._next(bias_at), *more)

        return linear

    def _next(self, bias_at: Iterator[Tensor]) -> Tensor:
        """Return the bias of the next step, `(B, out)`."""
        bias_t = next(bias_at, None)
        if bias_t is None:
            raise ForbesError(
                f"TimeLoop: more than {self.steps} steps, expected at most as many as it was prepared for. "
                "Prepare the loop again, for every step it makes"
            )
        return bias_t


class _DeferredGradient(torch.autograd.Function):
    """Identity on the biases of all steps; its backward pass forms the weight's gradient, which the steps left out."""

    @staticmethod
    def forward(ctx: Any, weight: Tensor, biases: Tensor, inputs: list[Tensor]) -> Tensor:
        ctx.inputs = inputs  # filled by the loop, after this call and before the backward pass
        return biases.view_as(biases)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        made = grad[: len(ctx.inputs)]  # a loop may end early
        return made.flatten(0, 1).T @ torch.cat(ctx.inputs), grad, None  # (out, in), (T, B, out)
