r"""Monotone rational-quadratic splines (Durkan et al., 2019, arXiv 1906.04032; Gregory and Delbourgo, 1982).

An increasing map of the box [-5, 5] to itself through K + 1 knots, the identity beyond it. Unlike an affine coupling
it splits one mode into several, even of a one-dimensional state.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from forbes.beliefs.flows import Coupling, FlowMap, LULinear
from forbes.deferred import Bind, bind_now
from forbes.errors import ForbesError
from forbes.fusion import fused

__all__ = ["SplineCoupling", "knot_table", "spline", "spline_inverse"]

BOUND = 5.0
"""B, half the side of the box: a base of unit scale is beyond it once in two million draws."""
MIN_SIZE = 1e-3
"""The smallest width and height of a bin, as a share of the box's side."""
LOG_SLOPE_BOUND = 3.0
"""Slopes at the knots stay within e^∓3."""


def knot_table(raw: Tensor) -> Tensor:
    r"""Give the bins of splines: shape `(*, 3 K - 1)`, anything, to `(*, 6, K)`.

    Widths and heights are softmax shares of the box's side, slopes at the K - 1 inner knots
    :math:`\exp(3 \tanh(u / 3))`, and 1 at both ends. All zeros give the identity.

    Returns:
        Rows: left edge, lower edge, width, height, slope at the left edge and at the right one.
    """
    bins = (raw.shape[-1] + 1) // 3
    shares = raw[..., : 2 * bins].unflatten(-1, (2, bins)).softmax(-1)  # (*, 2, K)
    sizes = 2 * BOUND * (MIN_SIZE + (1 - bins * MIN_SIZE) * shares)
    edges = pad(sizes[..., :-1], (1, 0), value=-BOUND).cumsum(-1)  # (*, 2, K)
    log_slopes = LOG_SLOPE_BOUND * (raw[..., 2 * bins :] / LOG_SLOPE_BOUND).tanh()  # (*, K - 1)
    slopes = torch.stack((pad(log_slopes, (1, 0)), pad(log_slopes, (0, 1))), -2).exp()  # (*, 2, K)
    return torch.cat((edges, sizes, slopes), -2)  # (*, 6, K)


def spline(x: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
    r"""Evaluate splines.

    .. math:: y = y_k + h\,\xi\,\frac{s\,\xi + d_k (1-\xi)}{s\,(1-2u) + (d_k + d_{k+1})\,u}, \qquad
              \xi = \frac{x - x_k}{w}, \ u = \xi(1-\xi), \ s = \frac{h}{w}

    Args:
        x: shape `(*)`.
        table: bins from `knot_table`, `(*, 6, K)`.

    Returns:
        y and :math:`\log \partial y / \partial x` in nats, both `(*)`.
    """
    inside = x.clamp(-BOUND, BOUND)
    left, lower, width, height, slope, next_slope = _bin_of(inside, table, edge=0)
    xi, s = ((inside - left) / width).clamp(0, 1), height / width
    denominator, log_slope = _derivative(xi, s, slope, next_slope)
    y = lower + height * xi * (s * xi + slope * (1 - xi)) / denominator
    # Beyond the box the spline stands still at its edge, where its slope is 1, and x goes on alone.
    return y + (x - inside), log_slope


def spline_inverse(y: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
    r"""Invert splines: the root in [0, 1] of a quadratic in ξ, by sums of positive numbers only.

    .. math:: \Delta = d_k (1-\eta) - d_{k+1}\,\eta, \quad r = \sqrt{\Delta^2 + 4 s^2 \eta (1-\eta)}, \quad
              \xi = \frac{2 s \eta}{2 s \eta + r + \Delta} = \frac{r - \Delta}{r - \Delta + 2 s (1-\eta)}, \quad
              \eta = \frac{y - y_k}{h}

    Args:
        y: shape `(*)`.
        table: bins from `knot_table`, `(*, 6, K)`.

    Returns:
        x and :math:`\log \partial y / \partial x` at it in nats, both `(*)`.
    """
    inside = y.clamp(-BOUND, BOUND)
    left, lower, width, height, slope, next_slope = _bin_of(inside, table, edge=1)
    eta, s = ((inside - lower) / height).clamp(0, 1), height / width  # rounding must not make the root imaginary
    delta = slope * (1 - eta) - next_slope * eta
    first = delta > 0  # the form in which r and Δ add up
    total = (delta.square() + 4 * s.square() * eta * (1 - eta)).sqrt() + torch.where(first, delta, -delta)
    below, above = 2 * s * eta, 2 * s * (1 - eta)
    xi = torch.where(first, below / (below + total), total / (total + above))
    return left + width * xi + (y - inside), _derivative(xi, s, slope, next_slope)[1]


def _bin_of(value: Tensor, table: Tensor, edge: int) -> tuple[Tensor, ...]:
    """Give the six numbers, `(*)` each, of the bin in which a value `(*)` lies; edge 0 looks along x, 1 along y."""
    index = (value[..., None] >= table[..., edge, 1:]).sum(-1)  # (*)
    table = table.expand(*index.shape, *table.shape[-2:])  # (*, 6, K)
    return table.gather(-1, index[..., None, None].expand(*index.shape, 6, 1)).squeeze(-1).unbind(-1)  # 6 x (*)


def _derivative(xi: Tensor, s: Tensor, slope: Tensor, next_slope: Tensor) -> tuple[Tensor, Tensor]:
    r"""Give the denominator :math:`q = s (1-2u) + (d_k + d_{k+1}) u`, at least s/2, and the log-slope.

    .. math:: \log \frac{\partial y}{\partial x} = \log \frac{s^2 (d_{k+1} \xi^2 + 2 s u + d_k (1-\xi)^2)}{q^2}
    """
    rest = 1 - xi
    u = xi * rest
    denominator = s * (1 - 2 * u) + (slope + next_slope) * u
    numerator = next_slope * xi.square() + 2 * s * u + slope * rest.square()
    return denominator, (numerator * (s / denominator).square()).log()


class SplineCoupling(Coupling):
    r"""Spline coupling: :math:`y_a = x_a`, and :math:`y_b` by one spline per dimension with knots :math:`NN(x_a, c)`.

    The last layer starts at zero, so the flow starts as the identity.

    Args:
        dim: D; of one dimension the knots depend on the context only.
        width: as of any `Coupling`.
        swap: likewise.
        bins: K, at least 2.

    Raises:
        ForbesError: when `bins` is below 2.
    """

    def __init__(self, dim: int, width: int, swap: bool, bins: int) -> None:
        if bins < 2:
            raise ForbesError(f"SplineCoupling: bins is {bins}, expected at least 2; one bin is the identity")
        super().__init__(dim, width, swap)
        self.knots = nn.Linear(width, self.other * (3 * bins - 1))
        nn.init.zeros_(self.knots.weight)
        nn.init.zeros_(self.knots.bias)

    def generator(self, bind: Bind, mixing: LULinear | None = None) -> FlowMap:
        """See `Coupling.generator`; the log-slopes are those of x_b."""
        return self.network(bind, self.knots.weight, self.knots.bias, _move, mixing, self.given, self.swap)

    def inverse(self, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.inverse`."""
        knots = self.knots.weight, self.knots.bias
        return self.network(bind_now, *knots, _move_back, None, self.given, self.swap)(y, share)


@fused
def _move(raw: Tensor, x: Tensor, given: int, swap: bool) -> tuple[Tensor, Tensor]:
    """Move x_b by splines of raw numbers, `(*, other (3 K - 1))`; give y, `(*, D)`, and the log-slopes of x_b."""
    return _move_by(spline, raw, x, given, swap)


@fused
def _move_back(raw: Tensor, y: Tensor, given: int, swap: bool) -> tuple[Tensor, Tensor]:
    """Move y_b back, likewise."""
    return _move_by(spline_inverse, raw, y, given, swap)


def _move_by(by: FlowMap, raw: Tensor, x: Tensor, given: int, swap: bool) -> tuple[Tensor, Tensor]:
    other = x.shape[-1] - given
    table = knot_table(raw.unflatten(-1, (other, -1)))  # (*, other, 6, K)
    before, after = x.split((other, given) if swap else (given, other), -1)
    moved, log_slope = by(before if swap else after, table)  # (*, other), (*, other)
    kept = (after if swap else before).expand(*moved.shape[:-1], -1)  # (*, given)
    return torch.cat((moved, kept) if swap else (kept, moved), -1), log_slope  # (*, D), (*, other)
