r"""Kalman filter and backward information filter of a linear-Gaussian system (Kalman, 1960; Anderson and Moore, 1979).

.. math:: s_1 \sim \tfrac1K \sum_k N(m_k, P_1), \qquad s_t = F s_{t-1} + u_t + N(0, Q), \qquad o_t = H s_t + N(0, R)

Covariances and gains do not depend on the observations, so they are computed once for all sequences and K starts.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.pomdps.base import AffineGaussian, ExactFilter
from forbes.pomdps.beliefs import GaussianMixtureBelief
from forbes.pomdps.distributions import DiagonalGaussian

__all__ = ["LinearSystem", "kalman_filter", "smoothing_conditional"]


class LinearSystem(NamedTuple):
    """The matrices of a linear-Gaussian system, float64."""

    transition: Tensor
    """F, `(D, D)`."""
    transition_covariance: Tensor
    """Q, `(D, D)`."""
    emission: Tensor
    """H, `(O, D)`."""
    emission_covariance: Tensor
    """R, `(O, O)`."""
    initial_mean: Tensor
    """m_k of K equally likely starts, `(K, D)`."""
    initial_covariance: Tensor
    """P_1, `(D, D)`."""


def kalman_filter(system: LinearSystem, observation: Tensor, drive: Tensor) -> ExactFilter:
    r"""Filter from each start, and weight the starts by their evidence.

    .. math::

        \text{predict } \mu^- = F \mu + u_t, \ P^- = F P F^\top + Q, \qquad
        \text{correct } \mu = \mu^- + G(o_t - H\mu^-), \ P = P^- - G S G^\top \\
        S = H P^- H^\top + R, \quad G = P^- H^\top S^{-1}, \qquad
        w_{k,t} \propto w_{k,t-1}\, N(o_t; H\mu_k^-, S)

    Args:
        system: matrices of the system.
        observation: observations o_t, `(B, T, O)`.
        drive: effect of the action on the state, u_t, `(B, T, D)`; the first is not used.

    Returns:
        Mixture of K Gaussians and evidence at each step.
    """
    transition, noise, emission, emission_noise, start, covariance = system
    mean = start.expand(len(observation), -1, -1)  # (B, K, D)
    log_weight = mean.new_full(mean.shape[:2], -math.log(len(start)))  # (B, K)
    steps: list[tuple[Tensor, ...]] = []
    covariances = []
    for time, observed in enumerate(observation.unbind(1)):
        if time > 0:
            mean = mean @ transition.T + drive[:, None, time]  # (B, K, D)
            covariance = transition @ covariance @ transition.T + noise
        spread = emission @ covariance @ emission.T + emission_noise  # (O, O)
        gain = torch.linalg.solve(spread, emission @ covariance).T  # (D, O)
        innovation = observed[:, None] - mean @ emission.T  # (B, K, O)
        log_joint = log_weight + _log_normal(innovation, spread)  # (B, K)
        evidence = log_joint.logsumexp(-1)  # (B,)
        log_weight = log_joint - evidence[:, None]
        mean = mean + innovation @ gain.T
        covariance = covariance - gain @ spread @ gain.T
        covariances.append(covariance)
        steps.append((log_weight, mean, evidence))
    log_weights, means, evidences = (torch.stack(values, 1) for values in zip(*steps, strict=True))  # (B, T, ...)
    return ExactFilter(GaussianMixtureBelief(log_weights, means, torch.stack(covariances)), evidences)  # (T, D, D)


def smoothing_conditional(system: LinearSystem, observation: Tensor, drive: Tensor) -> AffineGaussian:
    r"""Return :math:`p(s_t \mid s_{t-1}, o_{t:T})` for K = 1, by a backward recursion over future observations.

    .. math::

        p(o_{t:T} \mid s_t) \propto \exp(-\tfrac12 s_t^\top \Lambda_t s_t + \eta_t^\top s_t), \qquad
        \Lambda_t = H^\top R^{-1} H + F^\top M \Lambda_{t+1} F \\
        \eta_t = H^\top R^{-1} o_t + F^\top M (\eta_{t+1} - \Lambda_{t+1} u_{t+1}), \quad
        M = (I + \Lambda_{t+1} Q)^{-1}, \quad \Lambda_{T+1} = \eta_{T+1} = 0 \\
        p(s_t \mid s_{t-1}, o_{t:T}) = N\!\left(N_t (F s_{t-1} + u_t + Q \eta_t),\, N_t Q\right), \quad
        N_t = (I + Q \Lambda_t)^{-1}

    At t = 1, :math:`F s_{t-1} + u_t` is replaced by the initial mean, and Q by :math:`P_1`. The arguments are those of
    `kalman_filter`.
    """
    transition, noise, emission, emission_noise, start, start_covariance = system
    unit = torch.eye(len(noise), dtype=noise.dtype)
    reading = torch.linalg.solve(emission_noise, emission).T  # H' R^-1, (D, O)
    ahead, information = torch.zeros_like(noise), torch.zeros_like(drive[:, 0])  # Λ_{t+1} (D, D), η_{t+1} (B, D)
    steps: list[tuple[Tensor, Tensor, Tensor]] = []
    for time in reversed(range(observation.shape[1])):
        if time < observation.shape[1] - 1:
            back = transition.T @ torch.linalg.inv(unit + ahead @ noise)  # F' M, (D, D)
            information = (information - drive[:, time + 1] @ ahead.T) @ back.T
            ahead = back @ ahead @ transition
        information = information + observation[:, time] @ reading.T  # (B, D)
        ahead = ahead + reading @ emission
        spread = noise if time > 0 else start_covariance
        shrink = torch.linalg.inv(unit + spread @ ahead)  # N_t, (D, D)
        known = drive[:, time] if time > 0 else start  # the part independent of s_{t-1}, (B or 1, D)
        gain = shrink @ transition if time > 0 else torch.zeros_like(shrink)
        covariance = shrink @ spread
        steps.append((gain, (known + information @ spread) @ shrink.T, (covariance + covariance.T) / 2))
    gains, offsets, covariances = zip(*reversed(steps), strict=True)
    return AffineGaussian(torch.stack(gains), torch.stack(offsets, 1), torch.stack(covariances))


def _log_normal(deviation: Tensor, covariance: Tensor) -> Tensor:
    """Return log N(deviation; 0, covariance) in nats: `(*, O)` and `(O, O)` to `(*)`."""
    scale: Tensor = torch.linalg.cholesky(covariance)
    noise: Tensor = torch.linalg.solve_triangular(scale, deviation.mT, upper=False).mT  # (*, O)
    standard = DiagonalGaussian(torch.zeros_like(noise), 1.0).log_prob(noise)
    return standard - scale.diagonal().log().sum()
