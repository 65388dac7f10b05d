r"""Monotone rational-quadratic splines (Durkan et al., 2019, arXiv 1906.04032; Gregory and Delbourgo, 1982).

A spline is an increasing map of the interval [-5, 5] to itself through K + 1 knots. Outside it goes on as a straight
line, with its slope at the last knot. Unlike an affine coupling, it can split one mode into several, even in one
dimension.

Durkan et al. hold the slope at 1 at both ends, and let widths differ by any factor. A spline that shifts its input then
squeezes bins against an end. A sample in a bin that is narrow and turns has a log-density with a derivative in the
thousands, and trainings collapse (`docs/results/strokes-tried.md`). So here the slopes at the ends are learned, and no
bin is more than e² times as wide as another.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from forbes.beliefs.coupling import Coupling, bounded, join, split
from forbes.errors import ForbesError
from forbes.performance.flow_loop import CouplingLayers
from forbes.performance.fusion import fused

__all__ = ["SplineCoupling", "knot_table", "spline", "spline_inverse"]

BOUND = 5.0
"""B, half the side of the box: a standard normal sample is outside with probability 6e-7."""
LOG_WIDTH_BOUND = 1.0
"""Bound of |a|: the bins' widths differ by factors below e^2, so that 8 bins are between 0.19 and 5.1 wide."""
LOG_MEAN_BOUND = 1.5
"""Bound of |v|: the bins' mean slopes differ by factors below e^3 and stay within e^±3."""
LOG_SLOPE_BOUND = 1.0
"""Bound of |u|: the slope at a knot stays within a factor e^±1 of the harmonic mean of its bins' slopes."""
LOG_SLOPES = -4.22, 4.0
"""Bounds of the log-slope everywhere, in nats.

An inverse in float32 loses as many digits as the slope has leading zeros. With independent heights, as in Durkan et
al., log-slopes reach -16, and float32 has no digits left.
"""


def knot_table(raw: Tensor) -> Tensor:
    r"""Return the bins of splines, `(*, 6, K)`, from unconstrained numbers, `(*, 3 K + 1)`.

    The first K numbers, a, give the widths; the next K, v, the mean slopes; the last K + 1, u, the slopes at the knots:

    .. math:: w = 10\,\mathrm{softmax}(\tanh a), \quad
              s_k = \frac{10\,e^{1.5 \tanh(v_k / 1.5)}}{\sum_j w_j\,e^{1.5 \tanh(v_j / 1.5)}}, \quad h = s\,w, \quad
              d_k = \frac{2\,s_{k-1} s_k}{s_{k-1} + s_k}\,e^{\tanh u_k}

    At either end, where a bin has one neighbour only, :math:`d_k = s_k e^{\tanh u_k}`. All zeros give the
    identity. Unlike independent heights (Durkan et al.), these bound the slope inside a bin as well (`LOG_SLOPES`).

    Returns:
        Rows: left edge, lower edge, width, height, slope at the left edge and at the right one.
    """
    bins = raw.shape[-1] // 3
    of_width, of_mean, of_slope = raw.split((bins, bins, bins + 1), -1)
    width = bounded(of_width, LOG_WIDTH_BOUND).softmax(-1)  # fractions of the side, (*, K)
    mean = bounded(of_mean, LOG_MEAN_BOUND).exp()  # (*, K)
    mean = mean / (width * mean).sum(-1, keepdim=True)  # the heights add up to the side, too
    sizes = 2 * BOUND * torch.stack((width, width * mean), -2)  # (*, 2, K)
    edges = pad(sizes[..., :-1], (1, 0), value=-BOUND).cumsum(-1)  # (*, 2, K)
    before, after = torch.cat((mean[..., :1], mean), -1), torch.cat((mean, mean[..., -1:]), -1)  # 2 x (*, K + 1)
    harmonic = 2 * before * after / (before + after)  # (*, K + 1)
    slope = harmonic * bounded(of_slope, LOG_SLOPE_BOUND).exp()  # (*, K + 1)
    slopes = torch.stack((slope[..., :-1], slope[..., 1:]), -2)  # (*, 2, K)
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
    left, lower, width, height, slope, next_slope = _bin_of(x, table, edge=0)
    xi, s = ((x - left) / width).clamp(0, 1), height / width
    denominator, log_slope = _derivative(xi, s, slope, next_slope)
    y = lower + height * xi * (s * xi + slope * (1 - xi)) / denominator
    return y + _outside(x) * log_slope.exp(), log_slope


def spline_inverse(y: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
    r"""Invert splines: the root in [0, 1] of a quadratic in ξ, computed from sums of positive numbers only.

    .. math:: \Delta = d_k (1-\eta) - d_{k+1}\,\eta, \quad r = \sqrt{\Delta^2 + 4 s^2 \eta (1-\eta)}, \quad
              \xi = \frac{2 s \eta}{2 s \eta + r + \Delta} = \frac{r - \Delta}{r - \Delta + 2 s (1-\eta)}, \quad
              \eta = \frac{y - y_k}{h}

    Args:
        y: shape `(*)`.
        table: bins from `knot_table`, `(*, 6, K)`.

    Returns:
        x and :math:`\log \partial y / \partial x` at it in nats, both `(*)`.
    """
    left, lower, width, height, slope, next_slope = _bin_of(y, table, edge=1)
    eta, s = ((y - lower) / height).clamp(0, 1), height / width  # so that rounding makes no square root imaginary
    delta = slope * (1 - eta) - next_slope * eta
    first = delta > 0  # where the first form adds r and Δ
    total = (delta.square() + 4 * s.square() * eta * (1 - eta)).sqrt() + torch.where(first, delta, -delta)
    below, above = 2 * s * eta, 2 * s * (1 - eta)
    xi = torch.where(first, below / (below + total), total / (total + above))
    log_slope = _derivative(xi, s, slope, next_slope)[1]
    return left + width * xi + _outside(y) * (-log_slope).exp(), log_slope


def _outside(value: Tensor) -> Tensor:
    """Return how far a value is from the box, with its sign, `(*)`: what a line from the edge adds; 0 inside."""
    return value - value.clamp(-BOUND, BOUND)


def _bin_of(value: Tensor, table: Tensor, edge: int) -> tuple[Tensor, ...]:
    """Return the six numbers, `(*)` each, of a value's bin, or of the nearest: of x for edge 0, of y for edge 1."""
    index = (value[..., None] >= table[..., edge, 1:]).sum(-1)  # (*)
    table = table.expand(*index.shape, *table.shape[-2:])  # (*, 6, K)
    return table.gather(-1, index[..., None, None].expand(*index.shape, 6, 1)).squeeze(-1).unbind(-1)  # 6 x (*)


def _derivative(xi: Tensor, s: Tensor, slope: Tensor, next_slope: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the denominator :math:`q = s (1-2u) + (d_k + d_{k+1}) u \ge s/2` and the log-slope.

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
        dim: D; in one dimension the knots depend on the context only.
        width: W of the network.
        swap: False transforms the second part given the first, True the first given the second.
        bins: K, the number of bins per spline, at least 2.

    Raises:
        ForbesError: when `bins` is below 2.
    """

    def __init__(self, dim: int, width: int, swap: bool, bins: int) -> None:
        if bins < 2:
            raise ForbesError(f"SplineCoupling: bins is {bins}, expected at least 2; one bin is the identity")
        super().__init__(dim, width, swap)
        self.table_of = nn.Linear(width, self.other * (3 * bins + 1))
        nn.init.zeros_(self.table_of.weight)
        nn.init.zeros_(self.table_of.bias)

    def forward(self, x: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.forward`."""
        x_a, x_b = split(x, self.given, self.swap)
        y_b, log_slope = spline(x_b, self._table(x_a, context_term))
        return join(x_a, y_b, self.swap), log_slope

    def inverse(self, y: Tensor, context_term: Tensor) -> tuple[Tensor, Tensor]:
        """See `Coupling.inverse`."""
        y_a, y_b = split(y, self.given, self.swap)
        x_b, log_slope = spline_inverse(y_b, self._table(y_a, context_term))
        return join(y_a, x_b, self.swap), log_slope

    def layers(self) -> CouplingLayers:
        """See `Coupling.layers`."""
        last = self.table_of.weight, self.table_of.bias
        return CouplingLayers(self.wide_first(), self.inner, self.outer, *last, _transform, (self.given, self.swap))

    def _table(self, x_a: Tensor, context_term: Tensor) -> Tensor:
        """Return the bins of x_b's splines, `(*, other, 6, K)`."""
        raw = self.table_of(self.hidden(x_a, context_term))  # (*, other (3 K + 1))
        return knot_table(raw.unflatten(-1, (self.other, -1)))


@fused
def _transform(raw: Tensor, x: Tensor, given: int, swap: bool) -> tuple[Tensor, Tensor]:
    """Return y, `(*, D)`, and the log-slopes of x_b, from raw numbers of its splines, `(*, other (3 K + 1))`."""
    x_a, x_b = split(x, given, swap)
    y_b, log_slope = spline(x_b, knot_table(raw.unflatten(-1, (x_b.shape[-1], -1))))  # 2 x (*, other)
    return join(x_a, y_b, swap), log_slope
