"""Conditional normalizing flows: affine coupling layers with LU-linear layers between them (paper §2.2 and appendix).

One direction generates (base noise to state), the other evaluates (`inverse`); both cost the same.
"""

import math
from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, pad, softplus

from forbes.deferred import Affine, Bind
from forbes.errors import ForbesError

__all__ = ["AffineCoupling", "ConditionalFlow", "FlowMap", "LULinear"]

LOG_SCALE_BOUND = 2.0
"""|ℓ| stays below this in each layer: a plain exp explodes (nflows issue 49), a sigmoid could only contract."""

FlowMap: TypeAlias = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(x, context) to (y, log|det|)."""


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
        """Give L and U, each `(D, D)`."""
        diagonal = softplus(self.raw_diagonal) + 1e-3
        unit = torch.eye(len(diagonal), dtype=diagonal.dtype, device=diagonal.device)
        return self.factors.tril(-1) + unit, self.factors.triu(1) + diagonal.diag()  # (D, D), (D, D)

    def log_det(self) -> Tensor:
        """Give log|det LU| in nats, a scalar."""
        return (softplus(self.raw_diagonal) + 1e-3).log().sum()

    def matrix(self) -> Tensor:
        """Give LU, `(D, D)`."""
        lower, upper = self.triangles()
        return lower @ upper

    def inverse_matrix(self) -> Tensor:
        """Give (LU)⁻¹, `(D, D)`, by two triangular solves."""
        lower, upper = self.triangles()
        unit = torch.eye(len(lower), dtype=lower.dtype, device=lower.device)
        z = torch.linalg.solve_triangular(lower, unit, upper=False, unitriangular=True)
        inverse: Tensor = torch.linalg.solve_triangular(upper, z, upper=True)
        return inverse


class AffineCoupling(nn.Module):
    r"""Affine coupling: :math:`y_a = x_a` and :math:`y_b = x_b \odot e^{\ell} + t`, :math:`(\ell, t) = NN(x_a, c)`.

    The network is the paper's: a linear layer, one residual block of two linear layers, a linear layer. The context's
    share of the first layer arrives ready made (`ConditionalFlow` computes it for all layers in one matmul).
    :math:`\ell = 2 \tanh(u/2)` is bounded. The last layer starts at zero, so the flow starts as the identity.

    To have nothing to cut and join, the first layer reads all of x with zero weights for x_b, and the last one writes
    all of :math:`(\ell, t)` with zeros for x_a.

    Args:
        dim: D, at least 2.
        width: W of the network.
        swap: False transforms the second part given the first, True the first given the second.
    """

    def __init__(self, dim: int, width: int, swap: bool) -> None:
        super().__init__()
        given = dim // 2 if not swap else dim - dim // 2
        # Zeros to the left and to the right of what reads x_a, and of what writes (ℓ, t) of x_b.
        self.around_given = (dim - given, 0) if swap else (0, dim - given)
        self.around_other = (0, given) if swap else (given, 0)
        self.first = nn.Linear(given, width, bias=False)
        self.inner, self.outer = nn.Linear(width, width), nn.Linear(width, width)
        self.log_scale, self.shift = nn.Linear(width, dim - given), nn.Linear(width, dim - given)
        for layer in (self.log_scale, self.shift):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def network(self, bind: Bind) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Prepare (x, share) -> (tanh(u/2), t): shapes `(*, D)` and `(*, W)` to twice `(*, D)`, zeros for x_a."""
        weight = self.first.weight
        first = bind(pad(weight, self.around_given), weight.new_zeros(len(weight)))
        inner, outer = bind(self.inner.weight, self.inner.bias), bind(self.outer.weight, self.outer.bias)
        rows, columns = (0, 0, *self.around_other), self.around_other
        weight = torch.cat((pad(self.log_scale.weight / LOG_SCALE_BOUND, rows), pad(self.shift.weight, rows)))
        bias = torch.cat((pad(self.log_scale.bias / LOG_SCALE_BOUND, columns), pad(self.shift.bias, columns)))
        last = bind(weight, bias)  # (2 D, W), (2 D,)

        def network(x: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
            hidden = first(x) + share
            hidden = hidden + outer(inner(hidden.relu()).relu())
            raw, shift = last(hidden).chunk(2, -1)  # 2 x (*, D)
            return raw.tanh(), shift

        return network


class ConditionalFlow(nn.Module):
    r"""K coupling layers, an LU-linear layer between neighbours: :math:`f = f_K \circ \dots \circ f_1` given c.

    Args:
        dim: D, at least 2 (a coupling layer must split it).
        context_dim: C.
        layers: K coupling layers; alternate parts are transformed.
        width: W of each coupling network.

    Raises:
        ForbesError: when `dim` is below 2 or `layers` below 1.
    """

    def __init__(self, dim: int, context_dim: int, layers: int, width: int) -> None:
        super().__init__()
        if dim < 2:
            raise ForbesError(f"ConditionalFlow: state_dim is {dim}, a coupling layer needs at least 2 to split")
        if layers < 1:
            raise ForbesError(f"ConditionalFlow: layers is {layers}, expected at least 1; use GaussianBelief for none")
        self.context = nn.Linear(context_dim, layers * width)
        self.couplings = nn.ModuleList(AffineCoupling(dim, width, swap=bool(k % 2)) for k in range(layers))
        self.mixings = nn.ModuleList(LULinear(dim) for _ in range(layers - 1))

    def generator(self, bind: Bind) -> FlowMap:
        """Prepare (x, c) -> y = f(x; c), `(*, D)`, and log|det ∂y/∂x| in nats, `(*)`.

        What no context changes is computed here, once.
        """
        of_context = bind(self.context.weight, self.context.bias)
        couplings, lu_layers = self._layers()
        networks = [coupling.network(bind) for coupling in couplings]
        mixings = [bind(layer.matrix(), layer.bias) for layer in lu_layers]
        constant = self._constant_log_det()

        def generate(x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
            log_scales = []
            for k, share in enumerate(of_context(context).chunk(len(networks), -1)):  # K x (*, W)
                x = mixings[k - 1](x) if k > 0 else x
                half, shift = networks[k](x, share)
                log_scales.append(LOG_SCALE_BOUND * half)
                x = torch.addcmul(shift, x, log_scales[-1].exp())
            return x, torch.cat(log_scales, -1).sum(-1) + constant

        return generate

    def forward(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Generate: y = f(x; c), shape `(*, D)`, and log|det ∂y/∂x| in nats, shape `(*)`."""
        return self.generator(_bind_now)(x, context)

    def inverse(self, y: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate: x = f⁻¹(y; c), shape `(*, D)`, and the forward log|det ∂y/∂x| at it in nats, shape `(*)`."""
        couplings, lu_layers = self._layers()
        shares = self.context(context).chunk(len(couplings), -1)  # K x (*, W)
        log_scales = []
        for k in reversed(range(len(couplings))):
            half, shift = couplings[k].network(_bind_now)(y, shares[k])
            log_scales.append(LOG_SCALE_BOUND * half)
            y = (y - shift) * (-log_scales[-1]).exp()
            if k > 0:
                y = linear(y - lu_layers[k - 1].bias, lu_layers[k - 1].inverse_matrix())
        return y, torch.cat(log_scales, -1).sum(-1) + self._constant_log_det()

    def _layers(self) -> tuple[list[AffineCoupling], list[LULinear]]:
        return (
            [layer for layer in self.couplings if isinstance(layer, AffineCoupling)],
            [layer for layer in self.mixings if isinstance(layer, LULinear)],
        )

    def _constant_log_det(self) -> Tensor:
        """Sum the LU layers' log-determinants, a scalar."""
        return sum((layer.log_det() for layer in self._layers()[1]), start=self.context.bias.new_zeros(()))


def _bind_now(weight: Tensor, bias: Tensor) -> Affine:
    """Bind outside a time loop."""
    return lambda x: linear(x, weight, bias)
