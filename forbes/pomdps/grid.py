r"""Bayes filter of a scalar state on a grid: every integral is a sum over cells of equal width.

The sum is the midpoint rule. For smooth densities that vanish at both ends its error falls faster than any power of the
width. If a density has a kink, it falls with the square of the width, unless the grid is aligned (`Grid.around_kink`).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.errors import ForbesError
from forbes.pomdps.base import ExactFilter, Process
from forbes.pomdps.beliefs import GridBelief

__all__ = ["Grid", "grid_filter", "require_inside"]

EDGE_MASS = 1e-6
"""Maximal probability of an outermost cell. With more, the state may have left the grid."""


class Grid(NamedTuple):
    """Cells of equal width."""

    first: float
    """Centre of the first cell."""
    last: float
    """Centre of the last cell."""
    cells: int
    """Number of cells, G."""

    @classmethod
    def around_kink(cls, first: float, last: float, cells: int, kink: float) -> "Grid":
        r"""Shift a grid by less than a cell, such that a kink of the integrand causes the smallest error.

        If the slope jumps by J at a distance :math:`\theta\Delta` after a centre, the sum has the error
        :math:`-\tfrac12 J \Delta^2 B_2(\theta)` with :math:`B_2(\theta) = \theta^2 - \theta + \tfrac16`, by Euler and
        Maclaurin. It vanishes at :math:`\theta = (3 - \sqrt3) / 6`.
        """
        width = (last - first) / (cells - 1)
        shift = (kink - first) % width - (3 - math.sqrt(3)) / 6 * width
        return cls(first + shift, last + shift, cells)

    @property
    def width(self) -> float:
        r""":math:`\Delta`."""
        return (self.last - self.first) / (self.cells - 1)

    @property
    def centres(self) -> Tensor:
        """c_i, `(G,)` in float64."""
        return torch.linspace(self.first, self.last, self.cells, dtype=torch.float64)


def grid_filter(process: Process, grid: Grid, observation: Tensor, action: Tensor) -> ExactFilter:
    r"""Filter a process with a one-dimensional state by its densities.

    .. math::

        \pi_t(c_i) = \sum_j p(c_i \mid c_j, a_{t-1})\, m_{j,t-1}, \qquad
        p(o_t \mid o_{<t}) = \Delta \sum_i p(o_t \mid c_i)\, \pi_t(c_i), \qquad
        m_{i,t} = \frac{\Delta\, p(o_t \mid c_i)\, \pi_t(c_i)}{p(o_t \mid o_{<t})}

    A step costs B G² for the sum, and G² for each distinct action in the batch.

    Args:
        process: process with transition and emission densities.
        grid: grid of G cells.
        observation: o_t, `(B, T, O)`.
        action: a_{t-1}, `(B, T, A)`.

    Raises:
        ForbesError: if the belief reaches the end of the grid.
    """
    centres = grid.centres.unsqueeze(-1)  # (G, 1)

    @lru_cache(maxsize=1)  # a process without actions has one
    def density(*values: float) -> Tensor:
        """Return p(c_i | c_j, a), `(G, G)` with row j and column i."""
        one_action = torch.tensor(values, dtype=torch.float64)  # (A,)
        return process.log_transition(centres, centres.unsqueeze(1), one_action).exp()  # (G, G)

    seen = process.log_observation(observation.unsqueeze(2), centres)  # (B, T, G)
    log_predicted = process.log_initial(centres).expand(len(observation), -1)  # (B, G)
    log_masses: list[Tensor] = []
    evidences: list[Tensor] = []
    for time, log_density in enumerate(seen.unbind(1)):
        if time > 0:
            mass, predicted = log_masses[-1].exp(), torch.empty_like(log_predicted)
            for values in set(map(tuple, action[:, time].tolist())):
                rows = (action[:, time] == torch.tensor(values, dtype=torch.float64)).all(-1)  # (B,)
                predicted[rows] = mass[rows] @ density(*values)
            log_predicted = predicted.log()
        log_joint = log_predicted + log_density + math.log(grid.width)  # (B, G)
        evidences.append(log_joint.logsumexp(-1))  # (B,)
        log_masses.append(log_joint - evidences[-1].unsqueeze(-1))
    belief = GridBelief(torch.stack(log_masses, 1), grid.first, grid.width)  # (B, T, G)
    require_inside(type(process).__name__, belief)
    return ExactFilter(belief, torch.stack(evidences, 1))  # (B, T)


def require_inside(where: str, belief: GridBelief) -> None:
    """Raise a ForbesError if the mass in an outermost cell is so large that mass outside may be missing."""
    edge = torch.maximum(belief.log_mass[..., 0], belief.log_mass[..., -1])  # (B, T)
    if len(outside := torch.nonzero(~(edge <= math.log(EDGE_MASS)))):  # also if it is NaN
        sequence, step = outside[0].tolist()
        raise ForbesError(
            f"{where}: the belief of sequence {sequence} at step {step} reaches the end of the grid, expected at most "
            f"{EDGE_MASS:g} in its outermost cells. Exclude the sequence, which is very unlikely under the process"
        )
