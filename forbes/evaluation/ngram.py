r"""n-grams of pen moves: log-likelihoods and completions of digit strokes by a model without images.

A move m_t leads from one pixel of the pen's path to the next: to one of its 8 neighbours, or by a jump to any pixel x.

.. math::

    \log p(x_{1:T}) = \log p_1(x_1) + \sum_{t>1} \log p_n(m_t \mid m_{t-n}, \dots, m_{t-1})
                      + [m_t \text{ is a jump}] \log p_J(x_t)

    p_n(m \mid c) = \frac{N(c, m) + \alpha\, p_{n-1}(m \mid c')}{N(c) + \alpha}, \qquad p_{-1} = \tfrac19

N are counts in the training split, c' is the context c without its earliest move, and :math:`\alpha = 5`. First pixels
:math:`p_1` and targets of jumps :math:`p_J` are empirical, with :math:`\alpha` pseudo-counts spread over all pixels.
The path determines the frames, so this is a lower bound of their log-probability: a model of frames with a lower score
has not learned how a pen moves. Paths that are drawn stay in the image; moves that would leave it are not drawn.

Where the end of a digit is observed, it comes with a probability that depends on the step only. With M(t) of the M
training digits that have t steps, at each step before the end and at the first after it

.. math:: \log(1 - h_t), \quad \log h_t, \qquad
          h_t = \frac{M(t-1) + \alpha\, M / \sum_u u M(u)}{\sum_{u \ge t-1} M(u) + \alpha}
"""

from collections.abc import Iterator
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.data import Split, Strokes
from forbes.data.strokes.file import SIDE
from forbes.data.strokes.source import StrokePoints

__all__ = ["ORDERS", "NGrams", "fit_ngrams"]

ORDERS = (1, 2, 3, 4, 5)
_JUMP, _START, _SYMBOLS = 8, 9, 10
"""Moves are 0 to 7, or a jump; a context may also contain the start of the path."""
_PSEUDO_COUNTS = 5.0
_STEPS = torch.tensor([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0)])
"""(dx, dy) of the moves 0 to 7, int64 `(8, 2)`."""


class _Moves(NamedTuple):
    """Pen paths as moves; t counts points."""

    pixel: Tensor
    """x_t, int64 `(B, P)`."""
    move: Tensor
    """m_t that leads to x_t, int64 `(B, P)`; the first is `_START`."""
    valid: Tensor
    """False on padding, `(B, P)`."""


class NGrams:
    """n-grams of all `ORDERS`, fitted on the training digits up to some length.

    Args:
        source: digit strokes.
        length: number of steps T; later points of longer digits are ignored.
    """

    def __init__(self, source: Strokes, length: int) -> None:
        self.source, self.length = source, length
        pixel, move, valid = self._moves("train", source.size("train"))
        later = valid & (move != _START)
        self.counts = []
        for order in range(max(ORDERS) + 1):
            code = _context(move, order) * (_JUMP + 1) + move  # (B, P)
            size = _SYMBOLS**order * (_JUMP + 1)
            self.counts.append(torch.bincount(code[later], minlength=size).view(-1, _JUMP + 1).double())
        self.first = _log_frequency(pixel[:, 0])  # (H W,)
        self.target = _log_frequency(pixel[later & (move == _JUMP)])  # (H W,)
        self.hazard = _hazard(source.steps("train"), length)  # (T,)

    def log_prob(self, split: Split, count: int) -> dict[int, Tensor]:
        """Return log p of each step of the first `count` digits in nats, by order, float64 `(N, T)`; 0 on padding."""
        pixel, move, valid = self._moves(split, count)
        begins, jumps = move == _START, move == _JUMP
        log_pixel = self.first[pixel] * begins + self.target[pixel] * jumps  # (N, P)
        index = move.clamp(max=_JUMP)[..., None]
        by_order = {}
        for order, probability in enumerate(self._probabilities(move)):
            log_move = probability.gather(-1, index)[..., 0].log()  # (N, P)
            log_prob = (log_pixel + log_move * ~begins) * valid  # (N, P)
            by_order[order] = log_prob.unflatten(1, (self.length, -1)).sum(-1)  # (N, T)
        end = self._log_end(self.source.steps(split)[:count]) if self.source.end == "observed" else 0.0
        return {order: by_order[order] + end for order in ORDERS}

    def _log_end(self, steps: Tensor) -> Tensor:
        """Return log p of where each digit ends, given its number of steps, at each step: `(N,)` to `(N, T)`."""
        before = torch.arange(self.length)  # (T,), number of steps before each
        goes_on, ends = before < steps[:, None], before == steps[:, None]  # (N, T)
        return (1 - self.hazard).log() * goes_on + self.hazard.log() * ends

    def complete(self, points: Tensor, count: int, order: int) -> Tensor:
        """Draw more points of each path.

        Args:
            points: the first P points (x, y) of each path, uint8 `(B, P, 2)`.
            count: number of points to draw.
            order: order n, at most 5.

        Returns:
            The whole paths, uint8 `(B, P + count, 2)`. Where the end of a digit is observed, the last point of an ended
            path is repeated.
        """
        ended = torch.zeros(len(points), 1, dtype=torch.bool)
        for _ in range(count):
            if self.source.end == "observed":
                ended |= self._ends(points)
            point = torch.where(ended, points[:, -1], self._next(points, order))  # (B, 2)
            points = torch.cat((points, point[:, None]), 1)  # (B, P + 1, 2)
        return points

    def _ends(self, points: Tensor) -> Tensor:
        """Draw whether each path ends with the points that it has, `(B, P, 2)` to `(B, 1)`."""
        steps, rest = divmod(points.shape[1], self.source.points_per_step)
        hazard = 0.0 if rest else self.hazard[min(steps, self.length - 1)]
        return torch.rand(len(points), 1) < hazard

    def _next(self, points: Tensor, order: int) -> Tensor:
        """Draw the next point of each path, `(B, P, 2)` to uint8 `(B, 2)`."""
        last = points[:, -1:]  # (B, 1, 2)
        number = torch.full((len(points),), points.shape[1] + 1)
        move = _moves(StrokePoints(torch.cat((points, last), 1), number)).move  # (B, P + 1), with one yet to be drawn
        probability = next(islice(self._probabilities(move), order, None))[:, -1]  # (B, 9)
        jump = self.target.exp().multinomial(len(points), replacement=True)  # (B,)
        jump = torch.stack((jump % SIDE, jump // SIDE), -1)  # (B, 2)
        options = torch.cat((last + _STEPS, jump[:, None]), 1)  # (B, 9, 2)
        inside = ((options >= 0) & (options < SIDE)).all(-1)  # (B, 9)
        drawn = (probability * inside).multinomial(1)  # (B, 1)
        return options.take_along_dim(drawn[..., None], 1)[:, 0].to(torch.uint8)  # (B, 2)

    def _probabilities(self, move: Tensor) -> Iterator[Tensor]:
        """Yield p_n of all moves at each place of a path, float64 `(B, P, 9)`, for orders 0 to 5."""
        probability = torch.full((*move.shape, _JUMP + 1), 1 / (_JUMP + 1), dtype=torch.float64)
        for order, counts in enumerate(self.counts):
            of_context = counts[_context(move, order)]  # (B, P, 9)
            total = of_context.sum(-1, keepdim=True)
            probability = (of_context + _PSEUDO_COUNTS * probability) / (total + _PSEUDO_COUNTS)
            yield probability

    def _moves(self, split: Split, count: int) -> _Moves:
        points, number = self.source.gather(split, torch.arange(count), self.length)
        return _moves(StrokePoints(points, number))


@lru_cache(maxsize=2)
def fit_ngrams(source: Strokes, length: int) -> NGrams:
    """Return the n-grams of a source, fitted once."""
    return NGrams(source, length)


def _moves(paths: StrokePoints) -> _Moves:
    x, y = paths.points.long().unbind(-1)  # 2 x (B, P)
    dx, dy = x.diff(dim=1), y.diff(dim=1)  # 2 x (B, P - 1)
    square = 3 * (dx + 1) + dy + 1  # 0 … 8 among the neighbours, 4 the pixel itself
    near = (dx.abs() <= 1) & (dy.abs() <= 1) & (square != 4)
    move = torch.where(near, square - (square > 4).long(), _JUMP)  # (B, P - 1)
    start = torch.full_like(move[:, :1], _START)
    valid = torch.arange(x.shape[1]) < paths.number[:, None]  # (B, P)
    return _Moves(SIDE * y + x, torch.cat((start, move), 1), valid)  # (B, P)


def _hazard(steps: Tensor, length: int) -> Tensor:
    """Return the probability that a digit which has not ended does so before step t = 1 … T, float64 `(T,)`."""
    number = torch.bincount(steps, minlength=length).double()  # (L,)
    alive = number.flip(0).cumsum(0).flip(0)  # (L,), of at least so many steps
    mean = len(steps) / int(steps.sum())
    return ((number + _PSEUDO_COUNTS * mean) / (alive + _PSEUDO_COUNTS))[:length]


def _context(move: Tensor, order: int) -> Tensor:
    """Encode the `order` moves before each move as one integer in 0 … 10^order - 1, `(B, P)` to `(B, P)`."""
    context = torch.zeros_like(move)
    for back in range(1, order + 1):
        before = torch.full_like(move, _START)
        before[:, back:] = move[:, :-back]
        context = context * _SYMBOLS + before
    return context


def _log_frequency(pixel: Tensor) -> Tensor:
    """Return the log of the smoothed relative frequency of each pixel, float64 `(H W,)`."""
    count = torch.bincount(pixel, minlength=SIDE * SIDE).double()
    smooth = count + _PSEUDO_COUNTS / len(count)
    return (smooth / smooth.sum()).log()
