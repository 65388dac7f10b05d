r"""Monotone rational-quadratic splines (Durkan et al., 2019, arXiv 1906.04032; Gregory and Delbourgo, 1982).

An increasing map of the box [-5, 5] to itself through K + 1 knots, the identity beyond it. Unlike an affine coupling
it splits one mode into several, even of a one-dimensional state.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from forbes.beliefs.coupling import Coupling, FlowMap, LULinear
from forbes.errors import ForbesError
from forbes.performance.fusion import fused
from forbes.performance.time_loop import Bind, bind_now

__all__ = ["SplineCoupling", "knot_table", "spline", "spline_inverse"]

BOUND = 5.0
"""B, half the side of the box: a base of unit scale is beyond it once in two million draws."""
MIN_WIDTH = 1e-3
"""The smallest width of a bin, as a share of the box's side."""
LOG_MEAN_BOUND = 1.5
"""Mean slopes of the bins differ by factors below e^3, and stay within e^∓3."""
LOG_SLOPE_BOUND = 1.0
"""Slopes at inner knots stay within e^∓1 of the harmonic mean of their two bins'."""
LOG_SLOPES = -5.5, 4.0
"""Bounds of the log-slope everywhere, in nats; the lower one is that of a flat bin at the edge, where the slope is 1.

An inverse in float32 loses as many digits as the slope has zeros. With heights that are shares of their own, as in
Durkan et al., log-slopes reach -16, which is all that float32 has.
"""


def knot_table(raw: Tensor) -> Tensor:
    r"""Return the bins of splines: shape `(*, 3 K - 1)`, anything, to `(*, 6, K)`.

    The first K numbers a give the widths, the next K, v, the mean slopes, the last K - 1, u, the slopes at inner knots:

    .. math:: w = 10\,\mathrm{softmax}(a), \quad
              s_k = \frac{10\,e^{1.5 \tanh(v_k / 1.5)}}{\sum_j w_j\,e^{1.5 \tanh(v_j / 1.5)}}, \quad h = s\,w, \quad
              d_k = \frac{2\,s_{k-1} s_k}{s_{k-1} + s_k}\,e^{\tanh u_k}

    Widths have a floor of 1e-3 of the side. The slope is 1 at both ends. All zeros give the identity. Unlike heights
    that are shares of their own (Durkan et al.), these bound the slope inside a bin, too (`LOG_SLOPES`).

    Returns:
        Rows: left edge, lower edge, width, height, slope at the left edge and at the right one.
    """
    bins = (raw.shape[-1] + 1) // 3
    of_width, of_mean, of_slope = raw.split((bins, bins, bins - 1), -1)
    width = MIN_WIDTH + (1 - bins * MIN_WIDTH) * of_width.softmax(-1)  # (*, K), shares
    mean = (LOG_MEAN_BOUND * (of_mean / LOG_MEAN_BOUND).tanh()).exp()  # (*, K)
    mean = mean / (width * mean).sum(-1, keepdim=True)  # heights, too, add up to the side
    sizes = 2 * BOUND * torch.stack((width, width * mean), -2)  # (*, 2, K)
    edges = pad(sizes[..., :-1], (1, 0), value=-BOUND).cumsum(-1)  # (*, 2, K)
    before, after = mean[..., :-1], mean[..., 1:]
    harmonic = 2 * before * after / (before + after)  # (*, K - 1)
    slope = harmonic * (LOG_SLOPE_BOUND * (of_slope / LOG_SLOPE_BOUND).tanh()).exp()  # (*, K - 1)
    slopes = torch.stack((pad(slope, (1, 0), value=1.0), pad(slope, (0, 1), value=1.0)), -2)  # (*, 2, K)
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
    """Return the six numbers, `(*)` each, of the bin in which a value `(*)` lies; edge 0 looks along x, 1 along y."""
    index = (value[..., None] >= table[..., edge, 1:]).sum(-1)  # (*)
    table = table.expand(*index.shape, *table.shape[-2:])  # (*, 6, K)
    return table.gather(-1, index[..., None, None].expand(*index.shape, 6, 1)).squeeze(-1).unbind(-1)  # 6 x (*)


def _derivative(xi: Tensor, s: Tensor, slope: Tensor, next_slope: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the denominator :math:`q = s (1-2u) + (d_k + d_{k+1}) u`, at least s/2, and the log-slope.

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
        self.table_of = nn.Linear(width, self.other * (3 * bins - 1))
        nn.init.zeros_(self.table_of.weight)
        nn.init.zeros_(self.table_of.bias)

    def generator(self, bind: Bind, mixing: LULinear | None = None) -> FlowMap:
        """See `Coupling.generator`; the log-slopes are those of x_b."""
        return self.network(bind, self.table_of.weight, self.table_of.bias, _move, mixing, self.given, self.swap)

    def inverse(self, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.inverse`."""
        last = self.table_of.weight, self.table_of.bias
        return self.network(bind_now, *last, _move_back, None, self.given, self.swap)(y, share)


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
