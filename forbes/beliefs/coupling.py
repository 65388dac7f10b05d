"""Conditional normalizing flows: coupling layers with LU-linear layers between them (paper §2.2 and appendix).

The affine coupling here is the paper's; `splines.py` has another. `forward` maps base noise to a state,
`inverse` a state to its noise; both cost the same. `forbes.performance.flow_loop` has a faster form for time loops.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, pad, softplus

from forbes.errors import ForbesError
from forbes.performance.flow_loop import CouplingLayers, FlowStep, affine_layers, prepare_flow
from forbes.performance.time_loop import TimeLoop

__all__ = ["AffineCoupling", "ConditionalFlow", "Coupling", "CouplingFamily", "LULinear", "bounded", "join", "split"]

LOG_SCALE_BOUND = 2.0
"""|ℓ| stays below this in each layer: a plain exp explodes (nflows issue 49), a sigmoid could only contract."""

CouplingFamily: TypeAlias = Callable[[int, int, bool], "Coupling"]
"""Builds a coupling layer from (dim, width, swap): a class with its other arguments bound."""


class LULinear(nn.Module):
    r"""Invertible linear layer :math:`y = L U x + b`, identity at the start.

    L is unit lower triangular, U upper triangular with diagonal softplus(·) + 1e-3, so
    :math:`\log|\det| = \sum_d \log U_{dd}` is a sum and never needs a determinant.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.factors = nn.Parameter(torch.zeros(dim, dim))
        self.raw_diagonal = nn.Parameter(torch.full((dim,), math.log(math.expm1(1 - 1e-3))))
        self.bias = nn.Parameter(torch.zeros(dim))

    def forward(self, x: Tensor) -> Tensor:
        """Return y, `(*, D)`."""
        return linear(x, self.matrix(), self.bias)

    def inverse(self, y: Tensor) -> Tensor:
        """Return x, `(*, D)`."""
        return linear(y - self.bias, self.inverse_matrix())

    def triangles(self) -> tuple[Tensor, Tensor]:
        """Return L and U, each `(D, D)`."""
        diagonal = softplus(self.raw_diagonal) + 1e-3
        unit = torch.eye(len(diagonal), dtype=diagonal.dtype, device=diagonal.device)
        return self.factors.tril(-1) + unit, self.factors.triu(1) + diagonal.diag()  # (D, D), (D, D)

    def log_det(self) -> Tensor:
        """Return log|det LU| in nats, a scalar."""
        return (softplus(self.raw_diagonal) + 1e-3).log().sum()

    def matrix(self) -> Tensor:
        """Return LU, `(D, D)`."""
        lower, upper = self.triangles()
        return lower @ upper

    def inverse_matrix(self) -> Tensor:
        """Return (LU)⁻¹, `(D, D)`, by two triangular solves."""
        lower, upper = self.triangles()
        unit = torch.eye(len(lower), dtype=lower.dtype, device=lower.device)
        z = torch.linalg.solve_triangular(lower, unit, upper=False, unitriangular=True)
        inverse: Tensor = torch.linalg.solve_triangular(upper, z, upper=True)
        return inverse


class Coupling(nn.Module, ABC):
    r"""One part of x is kept, the other transformed given it: :math:`y_a = x_a,\ y_b = g(x_b; NN(x_a, c))`.

    g is elementwise and increasing. The network is the paper's: a linear layer, one residual block of two linear
    layers, and a last layer, which each kind of coupling defines. The first layer's term of the context is an argument,
    since `ConditionalFlow` computes it for all couplings in one product.

    Args:
        dim: D; if it is 1, all of x is transformed and the network reads the context only.
        width: W of the network.
        swap: False transforms the second part given the first, True the first given the second.
    """

    def __init__(self, dim: int, width: int, swap: bool) -> None:
        super().__init__()
        self.given = dim // 2 if not swap else dim - dim // 2
        self.other, self.swap = dim - self.given, swap
        self.first = nn.Linear(self.given, width, bias=False) if self.given else None
        self.inner, self.outer = nn.Linear(width, width), nn.Linear(width, width)

    @abstractmethod
    def forward(self, x: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """Return y, `(*, D)`, and the log-slopes log ∂y_b/∂x_b, whose sum is log|det ∂y/∂x|.

        Args:
            x: shape `(*, D)`.
            context_term: what the first layer adds for the context, `(*, W)`.
        """

    @abstractmethod
    def inverse(self, y: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """Return x, `(*, D)`, and the log-slopes of `forward` at it."""

    @abstractmethod
    def layers(self) -> CouplingLayers:
        """Return the layers for a time loop (`forbes.performance.flow_loop`)."""

    def hidden(self, x_a: Tensor, context_term: Tensor) -> Tensor:
        """Return what the last layer of NN(x_a, c) reads, `(*, W)`."""
        u = context_term if self.first is None else self.first(x_a) + context_term
        block: Tensor = self.outer(self.inner(u.relu()).relu())  # (*, W)
        return u + block

    def wide_first(self) -> Tensor | None:
        """Return the first layer's weight with zeros for x_b, `(W, D)`."""
        if self.first is None:
            return None
        return pad(self.first.weight, (self.other, 0) if self.swap else (0, self.other))


def split(x: Tensor, given: int, swap: bool) -> tuple[Tensor, Tensor]:
    """Return x_a, `(*, given)`, and x_b of x, `(*, D)`."""
    other = x.shape[-1] - given
    if swap:
        x_b, x_a = x.split((other, given), -1)
    else:
        x_a, x_b = x.split((given, other), -1)
    return x_a, x_b


def join(x_a: Tensor, x_b: Tensor, swap: bool) -> Tensor:
    """Return x, `(*, D)`, of its parts."""
    x_a = x_a.expand(*x_b.shape[:-1], -1)  # one x may meet many contexts
    return torch.cat((x_b, x_a) if swap else (x_a, x_b), -1)


def bounded(value: Tensor, bound: float) -> Tensor:
    """Return numbers within ±bound that are the values themselves near 0."""
    return bound * (value / bound).tanh()


class AffineCoupling(Coupling):
    r"""Affine coupling: :math:`y_a = x_a` and :math:`y_b = x_b \odot e^{\ell} + t`, :math:`(\ell, t) = NN(x_a, c)`.

    :math:`\ell = 2 \tanh(u/2)` is bounded. The layers of u and t start at zero, so the flow starts as the identity.

    Args:
        dim: D, at least 2.
        width: W of the network.
        swap: False transforms the second part given the first, True the first given the second.

    Raises:
        ForbesError: when `dim` is below 2.
    """

    def __init__(self, dim: int, width: int, swap: bool) -> None:
        if dim < 2:
            raise ForbesError(f"AffineCoupling: state_dim is {dim}, expected at least 2 to split. Use coupling: spline")
        super().__init__(dim, width, swap)
        self.log_scale, self.shift = nn.Linear(width, self.other), nn.Linear(width, self.other)
        for layer in (self.log_scale, self.shift):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.forward`."""
        x_a, x_b = split(x, self.given, self.swap)
        log_scale, shift = self._network(x_a, context_term)
        return join(x_a, x_b * log_scale.exp() + shift, self.swap), log_scale

    def inverse(self, y: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.inverse`."""
        y_a, y_b = split(y, self.given, self.swap)
        log_scale, shift = self._network(y_a, context_term)
        return join(y_a, (y_b - shift) * (-log_scale).exp(), self.swap), log_scale

    def layers(self) -> CouplingLayers:
        """See `Coupling.layers`."""
        block = self.wide_first(), self.inner, self.outer
        zeros = (0, self.given) if self.swap else (self.given, 0)
        return affine_layers(*block, self.log_scale, self.shift, zeros, LOG_SCALE_BOUND)

    def _network(self, x_a: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """Return (ℓ, t) = NN(x_a, c), `(*, other)` each."""
        u = self.hidden(x_a, context_term)
        log_scale = bounded(self.log_scale(u), LOG_SCALE_BOUND)
        return log_scale, self.shift(u)


class ConditionalFlow(nn.Module):
    r"""K coupling layers, an LU-linear layer between neighbours: :math:`f = f_K \circ \dots \circ f_1` given c.

    Args:
        dim: D, the dimension of x.
        context_dim: C, the dimension of the context.
        layers: K, the number of coupling layers; they transform the two parts of x in turn.
        width: W, the width of each coupling network.
        coupling: builds a layer from (dim, width, swap).

    Raises:
        ForbesError: when `layers` is below 1.
    """

    def __init__(
        self, dim: int, context_dim: int, layers: int, width: int, coupling: CouplingFamily = AffineCoupling
    ) -> None:
        super().__init__()
        if layers < 1:
            raise ForbesError(f"ConditionalFlow: layers is {layers}, expected at least 1; use GaussianBelief for none")
        self.context = nn.Linear(context_dim, layers * width)
        swaps = [dim > 1 and bool(k % 2) for k in range(layers)]  # a single dimension has no second part
        self.couplings = nn.ModuleList(coupling(dim, width, swap) for swap in swaps)
        self.mixings = nn.ModuleList(LULinear(dim) for _ in range(layers - 1))

    def forward(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Return y = f(x; c), `(*, D)`, and log|det ∂y/∂x| in nats, `(*)`, for x `(*, D)` and c `(*, C)`."""
        log_det = self._mixings_log_det()
        for mixing, coupling, context_term in self._layers(context):
            if mixing is not None:
                x = mixing(x)
            x, log_slope = coupling(x, context_term)  # (*, D), (*, other)
            log_det = log_det + log_slope.sum(-1)
        return x, log_det

    def inverse(self, y: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Return x = f⁻¹(y; c), `(*, D)`, and log|det ∂y/∂x| of the forward map at x in nats, `(*)`."""
        log_det = self._mixings_log_det()
        for mixing, coupling, context_term in reversed(self._layers(context)):
            y, log_slope = coupling.inverse(y, context_term)  # (*, D), (*, other)
            if mixing is not None:
                y = mixing.inverse(y)
            log_det = log_det + log_slope.sum(-1)
        return y, log_det

    def prepare(self, loop: TimeLoop) -> FlowStep:
        """Return `forward` for the steps of a loop: the same map with merged layers (`performance/flow_loop.py`)."""
        couplings = [coupling.layers() for coupling in self._couplings()]
        mixings = [(mixing.matrix(), mixing.bias) for mixing in self._mixings()]
        return prepare_flow(loop, self.context, couplings, mixings, self._mixings_log_det())

    def _layers(self, context: Tensor) -> list[tuple[LULinear | None, Coupling, Tensor]]:
        """Return every coupling with the layer before it and its context term, `(*, W)`."""
        context_terms = self.context(context).chunk(len(self.couplings), -1)  # K x (*, W)
        return list(zip([None, *self._mixings()], self._couplings(), context_terms, strict=True))

    def _couplings(self) -> list[Coupling]:
        return [layer for layer in self.couplings if isinstance(layer, Coupling)]

    def _mixings(self) -> list[LULinear]:
        return [layer for layer in self.mixings if isinstance(layer, LULinear)]

    def _mixings_log_det(self) -> Tensor:
        """Return the sum of the LU layers' log-determinants in nats, a scalar."""
        return sum((mixing.log_det() for mixing in self._mixings()), start=self.context.bias.new_zeros(()))
