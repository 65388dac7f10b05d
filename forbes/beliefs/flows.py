"""Conditional normalizing flows: affine coupling layers with LU-linear layers between them (paper §2.2 and appendix).

One direction generates (`forward`: base noise to state), the other evaluates (`inverse`); both cost the same.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from forbes.errors import ForbesError

__all__ = ["AffineCoupling", "ConditionalFlow", "LULinear"]

LOG_SCALE_BOUND = 2.0
"""|ℓ| stays below this in each layer: a plain exp explodes (nflows issue 49), a sigmoid could only contract."""


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

    def triangles(self) -> tuple[Tensor, Tensor, Tensor]:
        """Give L, U, each `(D, D)`, and log|det LU| in nats, a scalar."""
        diagonal = softplus(self.raw_diagonal) + 1e-3
        lower = self.factors.tril(-1) + torch.eye(len(diagonal), dtype=diagonal.dtype, device=diagonal.device)
        return lower, self.factors.triu(1) + diagonal.diag(), diagonal.log().sum()  # (D, D), (D, D), ()

    def inverse(self, y: Tensor) -> Tensor:
        """Give :math:`x = U^{-1} L^{-1} (y - b)`, shape `(*, D)`."""
        lower, upper, _ = self.triangles()
        z = torch.linalg.solve_triangular(lower.mT, y - self.bias, upper=True, left=False, unitriangular=True)
        return torch.linalg.solve_triangular(upper.mT, z, upper=False, left=False)


class AffineCoupling(nn.Module):
    r"""Affine coupling: :math:`y_a = x_a`, :math:`y_b = x_b \odot e^{\ell} + t`, with :math:`(\ell, t)` a network of :math:`(x_a, c)`.

    The network is the paper's: a linear layer, one residual block of two linear layers, a linear layer. The context's
    share of the first linear layer arrives ready made (`ConditionalFlow` computes it for all layers in one matmul).
    :math:`\ell = 2 \tanh(u/2)` is bounded. The last layer starts at zero, so the flow starts as the identity.

    Args:
        dim: D, at least 2.
        width: width of the network.
        swap: False transforms the second part given the first, True the first given the second.
    """

    def __init__(self, dim: int, width: int, swap: bool) -> None:
        super().__init__()
        self.swap = swap
        self.given = dim // 2 if not swap else dim - dim // 2
        self.first = nn.Linear(self.given, width, bias=False)
        self.block = nn.ModuleList([nn.Linear(width, width), nn.Linear(width, width)])
        self.last = nn.Linear(width, 2 * (dim - self.given))
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def scale_and_shift(self, given: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Give the bounded ℓ and t of the transformed part, each `(*, D_b)`, from x_a `(*, D_a)` and share `(*, W)`."""
        hidden = self.first(given) + share
        hidden = hidden + self.block[1](self.block[0](hidden.relu()).relu())
        raw, shift = self.last(hidden.relu()).chunk(2, -1)  # 2 x (*, D_b)
        return LOG_SCALE_BOUND * torch.tanh(raw / LOG_SCALE_BOUND), shift

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Give the part that is kept and the part that is transformed."""
        cut = x.shape[-1] - self.given if self.swap else self.given
        left, right = x[..., :cut], x[..., cut:]  # (*, cut), (*, D - cut)
        return (right, left) if self.swap else (left, right)

    def join(self, given: Tensor, other: Tensor) -> Tensor:
        """Undo `split`."""
        return torch.cat((other, given) if self.swap else (given, other), -1)  # (*, D)

    def forward(self, x: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Give y, shape `(*, D)`, and log|det ∂y/∂x| in nats, shape `(*)`."""
        given, other = self.split(x)
        log_scale, shift = self.scale_and_shift(given, share)
        return self.join(given, torch.addcmul(shift, other, log_scale.exp())), log_scale.sum(-1)

    def inverse(self, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Give x, shape `(*, D)`, and the log|det ∂y/∂x| of the forward direction at it, shape `(*)`."""
        given, other = self.split(y)
        log_scale, shift = self.scale_and_shift(given, share)
        return self.join(given, (other - shift) * (-log_scale).exp()), log_scale.sum(-1)


class ConditionalFlow(nn.Module):
    r"""K coupling layers with an LU-linear layer between neighbours: :math:`f = f_K \circ \dots \circ f_1`, conditioned on c.

    Args:
        dim: D, at least 2 (a coupling layer must split it).
        context_dim: C.
        layers: K coupling layers; alternate parts are transformed.
        width: width of each coupling network.

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

    def prepare(self) -> tuple[list[Tensor], Tensor]:
        """Compute what no context changes: the matrices LU, each `(D, D)`, and the sum of their log-determinants, `()`."""
        triangles = [mixing.triangles() for mixing in self.mixings]
        log_det = sum((log_det for _, _, log_det in triangles), start=self.context.bias.new_zeros(()))
        return [lower @ upper for lower, upper, _ in triangles], log_det

    def shares(self, context: Tensor) -> Sequence[Tensor]:
        """Compute the context's share of every coupling network's first layer, K x `(*, W)`, in one matmul."""
        return self.context(context).float().chunk(len(self.couplings), -1)

    def forward(
        self, x: Tensor, context: Tensor, prepared: tuple[list[Tensor], Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Generate: y = f(x; c), shape `(*, D)`, and log|det ∂y/∂x| in nats, shape `(*)`."""
        matrices, log_det = prepared or self.prepare()
        for k, (coupling, share) in enumerate(zip(self.couplings, self.shares(context), strict=True)):
            if k > 0:
                x = torch.nn.functional.linear(x, matrices[k - 1], self.mixings[k - 1].bias)
            x, term = coupling(x, share)
            log_det = log_det + term
        return x, log_det

    def inverse(self, y: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate: x = f⁻¹(y; c), shape `(*, D)`, and the forward log|det ∂y/∂x| at it in nats, shape `(*)`."""
        shares = self.shares(context)
        _, log_det = self.prepare()
        for k in reversed(range(len(self.couplings))):
            y, term = self.couplings[k].inverse(y, shares[k])
            log_det = log_det + term
            if k > 0:
                y = self.mixings[k - 1].inverse(y)
        return y, log_det
