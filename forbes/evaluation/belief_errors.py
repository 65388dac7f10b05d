r"""Errors of a belief relative to the exact one at each step: divergences, a proper score, width, and mode masses.

.. math::

    \mathrm{KL}(p \,\|\, q), \quad \mathrm{KL}(q \,\|\, p), \quad \log p(s_t) - \log q(s_t), \quad
    \frac{\operatorname{tr} \operatorname{Var} q}{\operatorname{tr} \operatorname{Var} p}, \quad
    \frac12 \sum_k |q(R_k) - p(R_k)|

p is the exact belief given o_1:t, and q the other belief. The forward KL is large if q misses a mode, the reverse KL if
q has mass where p has none. The third, a regret at the true state, has the forward KL as its mean. R_k are the states
nearest to the k-th of some fixed points, one per mode, so the regions are the same for every belief and step.
"""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from forbes.evaluation.scores import Increments
from forbes.pomdps import (
    ExactBelief,
    GaussianMixtureBelief,
    GridBelief,
    LightDark,
    MirrorSensor,
    MountainHike,
    Process,
    Ungm,
)
from forbes.pomdps.mountain_hike import STARTS

__all__ = ["ERRORS", "Belief", "belief_errors", "mode_centres", "moment_matched"]

ERRORS = ("forward_kl", "reverse_kl", "state_nll_regret", "variance_ratio", "mode_mass_error")
"""Errors returned by `belief_errors`. For the exact belief the ratio is 1 and all others are 0."""


class Belief(Protocol):
    """A distribution of s_t for every sequence and step, such as any `ExactBelief`."""

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Sample s_t, `(count, B, T, D)`."""

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density in nats, `(..., B, T, D)` to `(..., B, T)`."""


class _Nodes(NamedTuple):
    """Points with the weights that make a sum over them an expectation under either belief."""

    point: Tensor
    """States, `(N, B, T, D)`."""
    log_ratio: Tensor
    """log p - log q, `(N, B, T)`."""
    log_conditional: Tensor
    """The same where q is conditioned on the points, as its weights are."""
    weight: Tensor
    """Weights for p and for q, `(2, N, B, T)`."""


def belief_errors(
    exact: ExactBelief,
    belief: Belief,
    state: Tensor,
    modes: Tensor | None,
    samples: int,
    generator: torch.Generator,
) -> Increments:
    """Compare a belief with the exact one.

    If the exact belief is a grid, expectations are sums over its cells: without noise, and exact as long as the other
    belief is no narrower than a cell. Expectations under the other belief are then those given the grid. Otherwise both
    are sampled.

    Args:
        exact: exact beliefs p, batch shape `(B, T)`, float64.
        belief: beliefs q to compare, batch shape `(B, T)`.
        state: true states s_t, `(B, T, D)`.
        modes: one point per mode, `(K, D)`; None for a single mode, which has no mode-mass error.
        samples: number of samples of each belief.
        generator: random generator for the samples.

    Returns:
        `ERRORS` by name, `(B, T)` each; KLs and regret in nats.
    """
    nodes = _cells(exact, belief) if isinstance(exact, GridBelief) else _draws(exact, belief, samples, generator)
    of_exact, of_belief = nodes.weight  # 2 x (N, B, T)
    errors = {
        "forward_kl": _expectation(of_exact, nodes.log_ratio),
        "reverse_kl": _expectation(of_belief, -nodes.log_conditional),
        "state_nll_regret": exact.log_prob(state) - belief.log_prob(state),
        "variance_ratio": _variance(nodes.point, of_belief) / _variance(nodes.point, of_exact),
    }
    if modes is not None:
        distance = (nodes.point.unsqueeze(-2) - modes).square().sum(-1)  # (N, B, T, K)
        nearest = distance.argmin(-1, keepdim=True) == torch.arange(len(modes))  # (N, B, T, K)
        excess = ((of_belief - of_exact).unsqueeze(-1) * nearest).sum(0)  # (B, T, K)
        errors["mode_mass_error"] = excess.abs().sum(-1) / 2
    return errors


def mode_centres(process: Process) -> Tensor | None:
    """Return one point for each possible mode of the process's belief, `(K, D)`, or None if there is one mode.

    The modes are the two signs that an even sensor cannot distinguish, the two sides of the light, and the possible
    start corners of a hiker, who stays near them for long with steps of at most 0.05.
    """
    if isinstance(process, MirrorSensor | Ungm):
        return torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    if isinstance(process, LightDark):
        return torch.tensor([[4.0], [6.0]], dtype=torch.float64)
    if isinstance(process, MountainHike) and process.start == "multi":
        return torch.tensor(STARTS["multi"], dtype=torch.float64)
    return None


def moment_matched(exact: ExactBelief) -> GaussianMixtureBelief:
    """Return the diagonal Gaussian with the same mean and variance, which minimises the forward KL among them."""
    mean = exact.mean.unsqueeze(-2)  # (B, T, 1, D)
    return GaussianMixtureBelief(mean.new_zeros(mean.shape[:-1]), mean, exact.variance.diag_embed())


def _cells(exact: GridBelief, belief: Belief) -> _Nodes:
    """Return the cells of a grid as nodes (midpoint rule)."""
    point = exact.centres.expand(exact.log_mass.shape).movedim(-1, 0).unsqueeze(-1)  # (G, B, T, 1)
    log_exact, log_belief = exact.log_prob(point), belief.log_prob(point)  # 2 x (G, B, T)
    log_mass = torch.stack((log_exact, log_belief)).log_softmax(1)  # (2, G, B, T)
    return _Nodes(point, log_exact - log_belief, log_mass[0] - log_mass[1], log_mass.exp())


def _draws(exact: ExactBelief, belief: Belief, samples: int, generator: torch.Generator) -> _Nodes:
    r"""Sample n points from each belief, and use all 2n of them for both.

    .. math:: E_p f \approx \frac1n \sum_{i=1}^{2n} \frac{p(s_i)}{p(s_i) + q(s_i)}\, f(s_i)

    is unbiased, and no weight exceeds 1/n (the balance heuristic of Veach and Guibas, 1995). Both expectations share
    their noise, so the errors of two equal beliefs are exactly 0.
    """
    point = torch.cat((exact.sample(samples, generator), belief.sample(samples, generator)))  # (2 n, B, T, D)
    log_density = torch.stack((exact.log_prob(point), belief.log_prob(point)))  # (2, 2 n, B, T)
    log_ratio = log_density[0] - log_density[1]  # (2 n, B, T)
    return _Nodes(point, log_ratio, log_ratio, log_density.softmax(0) / samples)


def _expectation(weight: Tensor, values: Tensor) -> Tensor:
    """Return the weighted sum over points, `(N, *)` to `(*)`. Values with weight 0 may be infinite."""
    return (weight * values).where(weight > 0, 0.0).sum(0)


def _variance(point: Tensor, weight: Tensor) -> Tensor:
    """Return the trace of the variance, `(N, *, D)` and `(N, *)` to `(*)`."""
    probability = (weight / weight.sum(0)).unsqueeze(-1)  # (N, *, 1)
    mean = (probability * point).sum(0)  # (*, D)
    return (probability * (point - mean).square()).sum((0, -1))
