"""Conditional normalizing flows: coupling layers with LU-linear layers between them (paper §2.2 and appendix).

The affine coupling here is the paper's; `splines.py` has another. One direction generates (base noise to state), the
other evaluates (`inverse`); both cost the same.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, pad, softplus

from forbes.errors import ForbesError
from forbes.performance.fusion import Elementwise, fused, keep
from forbes.performance.time_loop import Bind, bind_now

__all__ = ["AffineCoupling", "ConditionalFlow", "Coupling", "CouplingFamily", "FlowMap", "LULinear"]

LOG_SCALE_BOUND = 2.0
"""|ℓ| stays below this in each layer: a plain exp explodes (nflows issue 49), a sigmoid could only contract."""

FlowMap: TypeAlias = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(x, context) to (y, log|det|)."""
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
    r"""One part of x moves, elementwise and increasing, as the rest says: :math:`y_a = x_a,\ y_b = g(x_b; NN(x_a, c))`.

    The network is the paper's: a linear layer, one residual block of two linear layers, and a last linear layer, which
    each kind of coupling has for itself. The context's share of the first layer arrives ready made (`ConditionalFlow`
    computes it for all layers in one matmul). To have nothing to cut, the first layer reads all of x with zero weights
    for x_b.

    Args:
        dim: D; if it is 1, all of x moves and the network reads the context only.
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
    def generator(self, bind: Bind, mixing: LULinear | None = None) -> FlowMap:
        """Prepare (x, share) -> (y, log-slopes): `(*, D)` and `(*, W)` to `(*, D)` and what sums to log|det ∂y/∂x|.

        With `mixing`, y is of the x that this layer makes first.
        """

    @abstractmethod
    def inverse(self, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Return x, `(*, D)`, and the forward log-slopes at it."""

    def network(
        self, bind: Bind, weight: Tensor, bias: Tensor, then: Elementwise, mixing: LULinear | None = None, *more: Any
    ) -> FlowMap:
        r"""Prepare (x, share) -> then(NN, x, ...), where NN ends in the layer with this weight and bias.

        Layers with nothing elementwise between them are one product each time: what mixes x and the first layer, and
        the block's second layer O, added to its input u, and the last layer L:

        .. math:: L (u + O v) = [L, L O]\,[u, v]
        """
        enter = self._entrance(bind, mixing)
        inner = bind(self.inner.weight, self.inner.bias, _extend)
        both = torch.cat((weight, weight @ self.outer.weight), 1)  # (out, 2 W)
        last = bind(both, bias + weight @ self.outer.bias, then)

        def run(x: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
            x, hidden, active = enter(x, share)
            moved: tuple[Tensor, Tensor] = last(inner(active, hidden), x, *more)
            return moved

        return run

    def _entrance(self, bind: Bind, mixing: LULinear | None) -> Callable[[Tensor, Tensor], tuple[Tensor, ...]]:
        """Prepare (x, share) -> x, mixed, the first layer's output, and its ReLU: `(*, D)`, `(*, W)`, `(*, W)`."""
        if self.first is None:
            mix = bind(mixing.matrix(), mixing.bias) if mixing else keep
            return lambda x, share: (mix(x), share, share.relu())
        weight = pad(self.first.weight, (self.other, 0) if self.swap else (0, self.other))  # (W, D)
        if mixing is None:
            first = bind(weight, weight.new_zeros(len(weight)), _join)
            return lambda x, share: (x, *first(x, share))
        matrix = mixing.matrix()
        rows = torch.cat((matrix, weight @ matrix))  # (D + W, D)
        return bind(rows, torch.cat((mixing.bias, weight @ mixing.bias)), _split_and_join)


class AffineCoupling(Coupling):
    r"""Affine coupling: :math:`y_a = x_a` and :math:`y_b = x_b \odot e^{\ell} + t`, :math:`(\ell, t) = NN(x_a, c)`.

    :math:`\ell = 2 \tanh(u/2)` is bounded. The last layer starts at zero, so the flow starts as the identity. To have
    nothing to join, it writes all of :math:`(\ell, t)` with zeros for x_a.

    Args:
        dim: D, at least 2.
        width: as of any `Coupling`.
        swap: likewise.

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

    def generator(self, bind: Bind, mixing: LULinear | None = None) -> FlowMap:
        """See `Coupling.generator`; the log-slopes are `(*, D)`."""
        return self.network(bind, *self._last(), _move, mixing)

    def inverse(self, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.inverse`."""
        return self.network(bind_now, *self._last(), _move_back)(y, share)

    def _last(self) -> tuple[Tensor, Tensor]:
        """Return weight and bias of the layer that writes (u/2, t), zeros for x_a: `(2 D, W)` and `(2 D,)`."""
        around = (0, self.given) if self.swap else (self.given, 0)
        rows = (0, 0, *around)
        weight = torch.cat((pad(self.log_scale.weight / LOG_SCALE_BOUND, rows), pad(self.shift.weight, rows)))
        bias = torch.cat((pad(self.log_scale.bias / LOG_SCALE_BOUND, around), pad(self.shift.bias, around)))
        return weight, bias


class ConditionalFlow(nn.Module):
    r"""K coupling layers, an LU-linear layer between neighbours: :math:`f = f_K \circ \dots \circ f_1` given c.

    Args:
        dim: D.
        context_dim: C.
        layers: K coupling layers; alternate parts are transformed.
        width: W of each coupling network.
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
        swaps = [dim > 1 and bool(k % 2) for k in range(layers)]  # one dimension has nothing to take turns with
        self.couplings = nn.ModuleList(coupling(dim, width, swap) for swap in swaps)
        self.mixings = nn.ModuleList(LULinear(dim) for _ in range(layers - 1))

    def generator(self, bind: Bind) -> FlowMap:
        """Prepare (x, c) -> y = f(x; c), `(*, D)`, and log|det ∂y/∂x| in nats, `(*)`.

        What no context changes is computed here, once.
        """
        of_context = bind(self.context.weight, self.context.bias)
        couplings, lu_layers = self._layers()
        steps = [
            coupling.generator(bind, mixing) for coupling, mixing in zip(couplings, [None, *lu_layers], strict=True)
        ]
        constant = self._constant_log_det()

        def generate(x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
            log_slopes = []
            for step, share in zip(steps, of_context(context).chunk(len(steps), -1), strict=True):  # K x (*, W)
                x, log_slope = step(x, share)
                log_slopes.append(log_slope)
            return x, _total(constant, *log_slopes)

        return generate

    def forward(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Generate: y = f(x; c), shape `(*, D)`, and log|det ∂y/∂x| in nats, shape `(*)`."""
        return self.generator(bind_now)(x, context)

    def inverse(self, y: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate: x = f⁻¹(y; c), shape `(*, D)`, and the forward log|det ∂y/∂x| at it in nats, shape `(*)`."""
        couplings, lu_layers = self._layers()
        shares = self.context(context).chunk(len(couplings), -1)  # K x (*, W)
        log_slopes = []
        for k in reversed(range(len(couplings))):
            y, log_slope = couplings[k].inverse(y, shares[k])
            log_slopes.append(log_slope)
            if k > 0:
                y = linear(y - lu_layers[k - 1].bias, lu_layers[k - 1].inverse_matrix())
        return y, _total(self._constant_log_det(), *log_slopes)

    def _layers(self) -> tuple[list[Coupling], list[LULinear]]:
        return (
            [layer for layer in self.couplings if isinstance(layer, Coupling)],
            [layer for layer in self.mixings if isinstance(layer, LULinear)],
        )

    def _constant_log_det(self) -> Tensor:
        """Sum the LU layers' log-determinants, a scalar."""
        return sum((layer.log_det() for layer in self._layers()[1]), start=self.context.bias.new_zeros(()))


@fused
def _join(of_x: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Add the shares of x and of the context; give the sum and its ReLU."""
    hidden = of_x + share
    return hidden, hidden.relu()


@fused
def _split_and_join(both: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x from what is x and its share, `(*, D + W)`, then as `_join`."""
    width = share.shape[-1]
    x, of_x = both.split((both.shape[-1] - width, width), -1)  # (*, D), (*, W)
    hidden = of_x + share
    return x, hidden, hidden.relu()


@fused
def _extend(inner: Tensor, hidden: Tensor) -> Tensor:
    """Return the block's input and what its second layer reads, side by side, `(*, 2 W)`."""
    return torch.cat((hidden, inner.relu()), -1)


@fused
def _move(raw: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return y and ℓ from (u/2, t), `(*, 2 D)`, and x, `(*, D)`."""
    log_scale, shift = _log_scale_and_shift(raw)
    return torch.addcmul(shift, x, log_scale.exp()), log_scale


@fused
def _move_back(raw: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and ℓ from y, likewise."""
    log_scale, shift = _log_scale_and_shift(raw)
    return (y - shift) * (-log_scale).exp(), log_scale


def _log_scale_and_shift(raw: Tensor) -> tuple[Tensor, Tensor]:
    half, shift = raw.chunk(2, -1)  # 2 x (*, D)
    return LOG_SCALE_BOUND * half.tanh(), shift


@fused
def _total(constant: Tensor, *log_slopes: Tensor) -> Tensor:
    """Add up log|det| from the layers' log-slopes, each `(*, D)`, to `(*)`."""
    return torch.cat(log_slopes, -1).sum(-1) + constant
