r"""The conditional flow in a time loop, with merged layers: the map that `forbes.beliefs.coupling` defines.

A step of a time loop has few rows, so it costs what its operations cost to start, and what it multiplies hardly counts.
Layers with nothing elementwise between them are therefore merged into one product, once before the loop:

- The layer M x + m that mixes x, and the next coupling's first layer F: :math:`[M; F M]\, x + [m; F m]`.
- The second layer O of the residual block, whose output is added to the block's input u, and the last layer L:
  :math:`L (u + O v + o) = [L, L O]\,[u, v] + L o`.
- x is neither split nor joined: F has columns of zeros for x_b, and an affine coupling's L has rows of zeros for x_a,
  so that :math:`\ell = t = 0` there.

The weights' gradients are deferred until after the loop (`TimeLoop`). `benchmarks/README.md` has the gain.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from forbes.performance.fusion import Elementwise, fused, identity
from forbes.performance.time_loop import TimeLoop

__all__ = ["CouplingLayers", "FlowStep", "affine_layers", "prepare_flow"]

FlowStep: TypeAlias = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(x, context) to (y, log|det|), for all of a flow; (x, context term) to (y, log-slopes) for one layer."""


class CouplingLayers(NamedTuple):
    """The layers of one coupling, y, log-slopes = transform(NN(x_a, c), x, *options)."""

    first: Tensor | None
    """Weight of the layer that reads x, `(W, D)`, zero for x_b; None where only the context is read."""
    inner: nn.Linear
    """First layer of the residual block, W to W."""
    outer: nn.Linear
    """Second layer of the residual block, W to W."""
    weight: Tensor
    """Weight of the last layer, `(out, W)`."""
    bias: Tensor
    """Bias of the last layer, `(out,)`."""
    transform: Elementwise
    """Elementwise function of the last layer's output, x `(*, D)` and the options, to y and log-slopes."""
    options: tuple[Any, ...]
    """Further arguments of the transform."""


def affine_layers(
    first: Tensor | None,
    inner: nn.Linear,
    outer: nn.Linear,
    log_scale: nn.Linear,
    shift: nn.Linear,
    zeros: tuple[int, int],
    bound: float,
) -> CouplingLayers:
    """Build the layers of an affine coupling, whose last layer writes (u / bound, t) of all of x in one product.

    Args:
        first: weight of the layer that reads x, `(W, D)`, zero for x_b.
        inner: as in `CouplingLayers`.
        outer: as in `CouplingLayers`.
        log_scale: last layer, writes u of x_b.
        shift: last layer, writes t of x_b.
        zeros: dimensions of x_a before x_b and after it, for which the last layer writes zeros.
        bound: the largest |ℓ|, of ℓ = bound tanh(u / bound).
    """
    weight = torch.cat([pad(w, (0, 0, *zeros)) for w in (log_scale.weight / bound, shift.weight)])  # (2 D, W)
    bias = torch.cat([pad(b, zeros) for b in (log_scale.bias / bound, shift.bias)])  # (2 D,)
    return CouplingLayers(first, inner, outer, weight, bias, _affine, (bound,))


def prepare_flow(
    loop: TimeLoop,
    context: nn.Linear,
    couplings: Sequence[CouplingLayers],
    mixings: Sequence[tuple[Tensor, Tensor]],
    log_det: Tensor,
) -> FlowStep:
    """Prepare a flow for a loop: what no context changes is computed here, once.

    Args:
        loop: the loop that calls the flow once a step.
        context: layer that writes the context terms of all couplings, `(B, C)` to `(B, K W)`.
        couplings: K coupling layers.
        mixings: matrix `(D, D)` and bias `(D,)` of each of the K - 1 layers between them.
        log_det: sum of the log-determinants of these matrices in nats, a scalar.

    Returns:
        (x, c) to y, `(B, D)`, and log|det ∂y/∂x| in nats, `(B,)`.
    """
    of_context = loop.linear(context.weight, context.bias)
    layers = [_prepare_coupling(loop, *layer) for layer in zip(couplings, [None, *mixings], strict=True)]

    def generate(x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        log_slopes = []
        for layer, context_term in zip(layers, of_context(context).chunk(len(layers), -1), strict=True):  # K x (B, W)
            x, log_slope = layer(x, context_term)
            log_slopes.append(log_slope)
        return x, _total(log_det, *log_slopes)

    return generate


def _prepare_coupling(loop: TimeLoop, coupling: CouplingLayers, mixing: tuple[Tensor, Tensor] | None) -> FlowStep:
    """Prepare a coupling of the x that the layer before it mixes."""
    enter = _prepare_entrance(loop, coupling.first, mixing)
    inner = loop.linear(coupling.inner.weight, coupling.inner.bias, _extend)
    weight = torch.cat((coupling.weight, coupling.weight @ coupling.outer.weight), 1)  # (out, 2 W)
    last = loop.linear(weight, coupling.bias + coupling.weight @ coupling.outer.bias, coupling.transform)

    def run(x: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        x, hidden, active = enter(x, context_term)
        transformed: tuple[Tensor, Tensor] = last(inner(active, hidden), x, *coupling.options)
        return transformed

    return run


def _prepare_entrance(
    loop: TimeLoop, first: Tensor | None, mixing: tuple[Tensor, Tensor] | None
) -> Callable[[Tensor, Tensor], tuple[Tensor, ...]]:
    """Prepare (x, context term) to mixed x, the first layer's output, and its ReLU: `(B, D)`, `(B, W)`, `(B, W)`."""
    if first is None:
        mix = loop.linear(*mixing) if mixing else identity
        return lambda x, context_term: (mix(x), context_term, context_term.relu())
    if mixing is None:
        read = loop.linear(first, first.new_zeros(len(first)), _join)
        return lambda x, context_term: (x, *read(x, context_term))
    matrix, bias = mixing
    return loop.linear(torch.cat((matrix, first @ matrix)), torch.cat((bias, first @ bias)), _split_and_join)


@fused
def _join(of_x: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum of the terms of x and of the context, and its ReLU."""
    hidden = of_x + context_term
    return hidden, hidden.relu()


@fused
def _split_and_join(both: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, the sum of the terms of x and of the context, and its ReLU, from [x, term of x], `(B, D + W)`."""
    width = context_term.shape[-1]
    x, of_x = both.split((both.shape[-1] - width, width), -1)  # (B, D), (B, W)
    hidden = of_x + context_term
    return x, hidden, hidden.relu()


@fused
def _extend(inner: Tensor, hidden: Tensor) -> Tensor:
    """Return [u, v], the residual block's input and what its second layer reads, `(B, 2 W)`."""
    return torch.cat((hidden, inner.relu()), -1)


@fused
def _affine(raw: Tensor, x: Tensor, bound: float) -> tuple[Tensor, Tensor]:
    """Return y and ℓ, `(B, D)` each, from (u / bound, t), `(B, 2 D)`."""
    half, shift = raw.chunk(2, -1)  # 2 x (B, D)
    log_scale = bound * half.tanh()
    return torch.addcmul(shift, x, log_scale.exp()), log_scale


@fused
def _total(log_det: Tensor, *log_slopes: Tensor) -> Tensor:
    """Return log|det ∂y/∂x|, `(B,)`, from the layers' log-slopes, each `(B, D)` or narrower."""
    return torch.cat(log_slopes, -1).sum(-1) + log_det
