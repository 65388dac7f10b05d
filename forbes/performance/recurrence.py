"""The networks of a filter in a time loop: a GRU cell, and an MLP part of whose input is known before the loop."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from forbes.performance.fusion import Elementwise, fused
from forbes.performance.time_loop import TimeLoop

__all__ = ["Layer", "prepare_gru", "prepare_mlp"]


class Layer(NamedTuple):
    """A linear layer and what follows it."""

    weight: Tensor
    """`(out, in)`."""
    bias: Tensor
    """`(out,)`."""
    activation: Elementwise
    """Function of the linear layer's output, `(B, out)`, and of `more`."""
    more: tuple[Tensor, ...] = ()
    """Parameters of the activation, such as those of a norm."""


def prepare_mlp(layers: Sequence[Layer], known: Tensor, loop: TimeLoop) -> Callable[[Tensor], Tensor]:
    r"""Prepare an MLP of [x, k] for a loop over x, where k is known for all steps.

    The first layer is split, :math:`W [x_t, k_t] + b = W_x x_t + (W_k k_t + b)`, and the term in brackets is one matrix
    product over all steps, before the loop.

    Args:
        layers: the layers in order.
        known: k_t, the last inputs of the network, `(B, T, K)`.
        loop: its batch is N copies of these B sequences.

    Returns:
        The MLP's output in one step, x `(N B, X)` to `(N B, width)`.
    """
    first, *others = layers
    weight_x, weight_known = first.weight.tensor_split([first.weight.shape[1] - known.shape[-1]], 1)
    term = linear(known.transpose(0, 1), weight_known, first.bias)  # (T, B, M)
    terms = term[:, None].expand(-1, loop.batch // len(known), -1, -1).flatten(1, 2)  # (T, N B, M)
    bound = [loop.linear(weight_x, terms, first.activation)]
    bound += [loop.linear(layer.weight, layer.bias, layer.activation) for layer in others]

    def run(x: Tensor) -> Tensor:
        for bound_linear, layer in zip(bound, layers, strict=True):
            x = bound_linear(x, *layer.more)
        return x

    return run


def prepare_gru(cell: nn.GRUCell, loop: TimeLoop) -> Callable[[Tensor, Tensor], Tensor]:
    r"""Prepare a GRU cell for a loop: (x, h) to the next h, `(B, H)`, the same numbers as `cell(x, h)`.

    .. math:: r, z = \sigma(W_{ir} x + W_{hr} h), \sigma(W_{iz} x + W_{hz} h), \quad
              n = \tanh(W_{in} x + r \odot W_{hn} h), \quad h' = n + z \odot (h - n)
    """
    of_input = loop.linear(cell.weight_ih, cell.bias_ih)
    of_hidden = loop.linear(cell.weight_hh, cell.bias_hh, _gate)
    return lambda x, hidden: of_hidden(hidden, of_input(x), hidden)


@fused
def _gate(of_hidden: Tensor, of_x: Tensor, hidden: Tensor) -> Tensor:
    """Return the next h of a GRU, `(B, H)`, from W_h h and W_i x with their biases, `(B, 3 H)` each."""
    sizes = [2 * hidden.shape[-1], hidden.shape[-1]]
    gates_x, new_x = of_x.split(sizes, -1)  # (B, 2 H), (B, H)
    gates_h, new_h = of_hidden.split(sizes, -1)  # (B, 2 H), (B, H)
    reset, update = (gates_x + gates_h).sigmoid().chunk(2, -1)  # 2 x (B, H)
    return torch.lerp(torch.addcmul(new_x, reset, new_h).tanh(), hidden, update)
