r"""Theorem 1 of the paper in closed form: the gap of the ELBO, and the belief that maximises it.

.. math:: s_1 \sim N(0, P_1), \quad s_t = F s_{t-1} + N(0, Q), \quad o_t = s_t + N(0, R)

For a posterior :math:`q = \prod_t q_t(s_t \mid s_{t-1}, o)` the identity, in nats per sequence, is

.. math:: \log p(o_{1:T}) - \mathrm{ELBO} = E_q \sum_t \mathrm{KL}\big(q_t \,\|\, p(s_t \mid s_{t-1}, o_{t:T})\big).

The paper has the filtering posterior :math:`p(s_t \mid o_{1:t})` as the last term, for which the identity does not
hold. All is float64. Everything is quadratic in s and o, so an expectation is a trace with the second moment of o,
`(T, T)`. With `process.moment()` it is the mean over :math:`o \sim p`; with the outer product of a sequence with
itself, the value for that sequence.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal, Normal

__all__ = ["POSTERIORS", "PROCESSES", "BeliefScores", "ClosedFormProcess", "Conditional", "Identity", "belief_scores"]
__all__ += ["between", "elbo", "exact_filter", "exact_one_step", "expected_kl", "factorised_optimum", "identity"]
__all__ += ["log_evidence", "sample_gap", "smoothing", "structured_optimum"]


class ClosedFormProcess(NamedTuple):
    """Parameters of the process, with variances instead of standard deviations."""

    transition: float = 1.0
    """F."""
    process_noise: float = 1.0
    """Q, above 0."""
    observation_noise: float = 1.0
    """R, above 0."""
    steps: int = 15
    """T."""
    first_variance: float = 1.0
    """P_1, above 0."""

    def noise(self) -> Tensor:
        """Return the variance that each step adds: P_1, Q, ..., Q, `(T,)`."""
        noise = torch.full((self.steps,), self.process_noise, dtype=torch.float64)
        noise[0] = self.first_variance
        return noise

    def precision(self) -> Tensor:
        """Return the inverse covariance of (s, o) jointly, `(2 T, 2 T)`."""
        eye = torch.eye(self.steps, dtype=torch.float64)
        step = eye - self.transition * _shift(self.steps)  # step @ s is the process noise
        states = step.T @ torch.diag(1 / self.noise()) @ step  # (T, T)
        seen = eye / self.observation_noise
        return torch.cat((torch.cat((states + seen, -seen), 1), torch.cat((-seen, seen), 1)))  # (2 T, 2 T)

    def moment(self) -> Tensor:
        """Return E[o o'], the covariance of o_1:T, `(T, T)`."""
        eye = torch.eye(self.steps, dtype=torch.float64)
        step = eye - self.transition * _shift(self.steps)
        paths: Tensor = torch.linalg.solve_triangular(step, eye, upper=False)  # s = paths @ noise
        return paths @ torch.diag(self.noise()) @ paths.T + self.observation_noise * eye


class Conditional(NamedTuple):
    r"""Densities :math:`N(s_t;\; a_t s_{t-1} + \sum_u B_{tu} o_u,\; v_t)` for all t: a posterior, belief or target."""

    carry: Tensor
    """a_t, `(T,)`; a_1 is 0."""
    gain: Tensor
    """B, `(T, T)`; lower triangular if it depends on the past only."""
    variance: Tensor
    """v_t, `(T,)`."""

    def marginal(self) -> "Conditional":
        """Integrate out s_1:t-1: return the belief q(s_t | o_1:T), which does not depend on s_{t-1}."""
        mean, spread = self._paths()
        return Conditional(torch.zeros_like(self.carry), mean, spread.square().sum(1))

    def joint_moment(self, moment: Tensor) -> Tensor:
        """Return the second moment of (s, o), `(2 T, 2 T)`, under q(s | o) and the second moment of o, `(T, T)`."""
        mean, spread = self._paths()
        cross = mean @ moment
        states = cross @ mean.T + spread @ spread.T
        return torch.cat((torch.cat((states, cross), 1), torch.cat((cross.T, moment), 1)))  # (2 T, 2 T)

    def _paths(self) -> tuple[Tensor, Tensor]:
        """Unroll the conditionals: s = mean @ o + spread @ e with e standard normal; each `(T, T)`."""
        steps = len(self.carry)
        step = torch.eye(steps, dtype=torch.float64) - self.carry[:, None] * _shift(steps)
        both = torch.cat((self.gain, torch.diag(self.variance.sqrt())), 1)  # (T, 2 T)
        mean, spread = torch.linalg.solve_triangular(step, both, upper=False).chunk(2, 1)  # (T, T), (T, T)
        return mean, spread


def _shift(steps: int) -> Tensor:
    """Return the matrix that takes s_t to its predecessor s_{t-1}, `(T, T)`."""
    return torch.diag(torch.ones(steps - 1, dtype=torch.float64), -1)


def log_evidence(process: ClosedFormProcess, moment: Tensor) -> Tensor:
    """Return the mean of log p(o_1:T) in nats over observations with this second moment, by one-step predictions."""
    predicted = _predictive(process, exact_filter(process))
    innovation = torch.eye(process.steps, dtype=torch.float64) - predicted.gain  # times o: the prediction error
    square = ((innovation @ moment) * innovation).sum(1)  # (T,)
    return -0.5 * ((2 * math.pi * predicted.variance).log() + square / predicted.variance).sum()


def elbo(process: ClosedFormProcess, posterior: Conditional, moment: Tensor) -> Tensor:
    """Return the mean of E_q[log p(s, o) - log q(s | o)] in nats over observations with this second moment."""
    square = (process.precision() * posterior.joint_moment(moment)).sum()
    constant = 2 * process.steps * math.log(2 * math.pi) + process.steps * math.log(process.observation_noise)
    entropy = 0.5 * (2 * math.pi * math.e * posterior.variance).log().sum()
    return -0.5 * (square + constant + process.noise().log().sum()) + entropy


def expected_kl(posterior: Conditional, target: Conditional, moment: Tensor) -> Tensor:
    r"""Return the mean of :math:`E_q \sum_t \mathrm{KL}(q_t \| p_t)` in nats: the right side, for target `smoothing`.

    .. math:: \mathrm{KL}_t = \tfrac12\big(v/w - 1 - \log(v/w) + E[(\mu_q - \mu_p)^2]/w\big),
              \qquad v, w \text{ the variances of } q_t, p_t
    """
    carry = (posterior.carry - target.carry)[:, None] * _shift(len(posterior.carry))
    apart = torch.cat((carry, posterior.gain - target.gain), 1)  # (T, 2 T), times (s, o): the difference of the means
    square = ((apart @ posterior.joint_moment(moment)) * apart).sum(1)  # (T,)
    ratio = posterior.variance / target.variance
    return 0.5 * (ratio - 1 - ratio.log() + square / target.variance).sum()


def exact_filter(process: ClosedFormProcess) -> Conditional:
    """Return the exact belief p(s_t | o_1:t) by the Kalman filter; as a posterior it is independent over t."""
    gains, variances = [], []
    gain = torch.zeros(process.steps, dtype=torch.float64)
    variance = torch.tensor(0.0, dtype=torch.float64)
    for noise, current in zip(process.noise(), torch.eye(process.steps, dtype=torch.float64), strict=True):
        predicted = process.transition**2 * variance + noise
        weight = predicted / (predicted + process.observation_noise)
        gain = (1 - weight) * process.transition * gain + weight * current
        variance = (1 - weight) * predicted
        gains.append(gain)
        variances.append(variance)
    zero = torch.zeros(process.steps, dtype=torch.float64)
    return Conditional(zero, torch.stack(gains), torch.stack(variances))


def exact_one_step(process: ClosedFormProcess) -> Conditional:
    """Return p(s_t | s_{t-1}, o_t), which is exact except that it ignores later observations."""
    zero = torch.zeros(process.steps, process.steps, dtype=torch.float64)
    return _with_future(process, zero[0], zero)


def smoothing(process: ClosedFormProcess) -> Conditional:
    """Return p(s_t | s_{t-1}, o_t:T), the true conditionals of the posterior p(s | o)."""
    return _with_future(process, *_future(process))


def structured_optimum(process: ClosedFormProcess) -> Conditional:
    """Return the q(s_t | s_{t-1}, o_1:t) with the highest ELBO.

    It is `smoothing` with each later o_u replaced by E[o_u | o_1:t]. Its variance is that of a posterior that knows the
    future, its mean does not know the future, so it is over-confident. By the identity q_t minimises KL(q_t || p_t)
    averaged over the future, and the average of log p_t is the log-density of this Gaussian up to a constant. Later
    terms do not change: both means have the same coefficient of s_t.
    """
    precision, information = _future(process)
    time = torch.arange(process.steps)
    # E[o_u | o_1:t] = F^(u-t) E[s_t | o_1:t]
    ahead = process.transition ** (time - time[:, None]).clamp_min(0).double()  # (T, T)
    weight = (information * ahead).sum(1, keepdim=True)  # (T, 1)
    return _with_future(process, precision, weight * exact_filter(process).gain)


def _future(process: ClosedFormProcess) -> tuple[Tensor, Tensor]:
    r"""Return J, `(T,)`, and H, `(T, T)`, the information of future observations about s_t.

    .. math:: p(o_{t+1:T} \mid s_t) \propto \exp(-J_t s_t^2 / 2 + s_t \sum_u H_{tu} o_u)

    Backwards from (0, 0), a step multiplies by p(o_t | s_t), then integrates s_t out against p(s_t | s_{t-1}).
    """
    q, r = process.process_noise, process.observation_noise
    precisions, rows = [], []
    precision = torch.tensor(0.0, dtype=torch.float64)
    row = torch.zeros(process.steps, dtype=torch.float64)
    for current in torch.eye(process.steps, dtype=torch.float64).flip(0):
        precisions.append(precision)
        rows.append(row)
        spread = 1 + q * (precision + 1 / r)
        row = process.transition * (row + current / r) / spread
        precision = process.transition**2 * (precision + 1 / r) / spread
    return torch.stack(precisions[::-1]), torch.stack(rows[::-1])  # (T,), (T, T)


def _with_future(process: ClosedFormProcess, precision: Tensor, information: Tensor) -> Conditional:
    r"""Normalise :math:`p(s_t \mid s_{t-1})\, p(o_t \mid s_t)\, \exp(-J_t s_t^2 / 2 + s_t \sum_u H_{tu} o_u)`."""
    variance = 1 / (1 / process.noise() + 1 / process.observation_noise + precision)
    carry = variance * process.transition / process.noise()
    carry[0] = 0
    current = torch.eye(process.steps, dtype=torch.float64) / process.observation_noise
    return Conditional(carry, variance[:, None] * (current + information), variance)


def factorised_optimum(process: ClosedFormProcess) -> Conditional:
    r"""Return the q(s_t | o_1:t), independent over t, with the highest ELBO.

    With L the precision of s given o, its variance is :math:`1 / L_{tt}`, that of s_t given both neighbours. Its mean
    solves :math:`L_{tt} m_t = F/Q\,(m_{t-1} + E[m_{t+1} \mid o_{1:t}]) + o_t/R`. With the filter's mean :math:`\mu_t`
    this is :math:`m_t = \alpha_t \mu_t + \beta_t m_{t-1} + \gamma_t o_t`. The coefficients follow by a backward
    recursion, since given the past both :math:`\mu_{t+1}` and :math:`o_{t+1}` have the mean :math:`F \mu_t`.
    """
    diagonal = process.precision().diagonal()[: process.steps]  # (T,)
    link = process.transition / process.process_noise
    coefficients = []
    alpha = beta = gamma = torch.tensor(0.0, dtype=torch.float64)
    for precision in diagonal.flip(0):
        rest = precision - link * beta
        alpha = link * process.transition * (alpha + gamma) / rest
        beta, gamma = link / rest, 1 / (process.observation_noise * rest)
        coefficients.append((alpha, beta, gamma))
    rows, row = [], torch.zeros(process.steps, dtype=torch.float64)  # m_0 = 0
    eye = torch.eye(process.steps, dtype=torch.float64)
    for (alpha, beta, gamma), mean, current in zip(coefficients[::-1], exact_filter(process).gain, eye, strict=True):
        row = alpha * mean + beta * row + gamma * current
        rows.append(row)
    return Conditional(torch.zeros_like(diagonal), torch.stack(rows), 1 / diagonal)


PROCESSES = (ClosedFormProcess(1.0, 1.0, 1.0), ClosedFormProcess(1.0, 0.1, 1.0), ClosedFormProcess(0.9, 0.3, 0.5))
"""The processes for which Theorem 1 is checked."""
POSTERIORS: Mapping[str, Callable[[ClosedFormProcess], Conditional]] = {
    "exact p(s_t|o_1:t)": exact_filter,
    "exact p(s_t|s_t-1,o_t)": exact_one_step,
    "best q(s_t|o_1:t)": factorised_optimum,
    "best q(s_t|s_t-1,o_1:t)": structured_optimum,
}
"""The posteriors that are compared; best is by the ELBO."""


class Identity(NamedTuple):
    """Both sides of the identity, means over o ~ p in nats per sequence."""

    gap: float
    """log p - ELBO."""
    smoothing: float
    """Σ KL to the smoothing conditionals, which equals the gap."""
    filtering: float
    """Σ KL to the filtering posterior, the right side in the paper."""


def identity(process: ClosedFormProcess, posterior: Conditional) -> Identity:
    """Return both sides of the identity for a posterior."""
    moment = process.moment()
    gap = log_evidence(process, moment) - elbo(process, posterior, moment)
    sums = (expected_kl(posterior, target(process), moment).item() for target in (smoothing, exact_filter))
    return Identity(gap.item(), *sums)


def between(first: Conditional, second: Conditional, fraction: float) -> Conditional:
    """Interpolate between two posteriors: linearly in a and B, log-linearly in v.

    Between two posteriors that are independent over t the ELBO is concave, so it rises monotonically to its optimum.
    """
    log_variance = torch.lerp(first.variance.log(), second.variance.log(), fraction)
    carry, gain = torch.lerp(first.carry, second.carry, fraction), torch.lerp(first.gain, second.gain, fraction)
    return Conditional(carry, gain, log_variance.exp())


class BeliefScores(NamedTuple):
    """Scores of a posterior by its ELBO, and of its marginals as beliefs q(s_t | o_1:t); means over o ~ p."""

    elbo_gap: float
    """log p - ELBO, nats per sequence."""
    prequential_deficit: float
    """log p minus the predictive log-likelihood sum_t log p(o_t | belief at t - 1), nats per sequence."""
    kl: float
    """sum_t KL(belief || exact belief), nats per sequence."""
    state_nll: float
    """-log belief(s_t) of the true state, nats per step."""
    variance_ratio: float
    """The belief's variance over the exact belief's, at the middle step."""
    coverage: float
    """Probability that the belief's central 90 % hold the true state, at the middle step."""


def belief_scores(process: ClosedFormProcess, posterior: Conditional) -> BeliefScores:
    r"""Score a posterior that depends on the past only, in closed form.

    The true state is :math:`N(\mu_t, P_t)` given o_1:t, so its distance from a belief's mean m has variance
    :math:`P_t + E[(\mu_t - m_t)^2]`. The deficit is the sum of KL(true predictive density || the belief's).
    """
    moment, exact, belief = process.moment(), exact_filter(process), posterior.marginal()
    apart = belief.gain - exact.gain  # (T, T)
    error = exact.variance + ((apart @ moment) * apart).sum(1)  # (T,), E[(s_t - m_t)²]
    nll = 0.5 * ((2 * math.pi * belief.variance).log() + error / belief.variance).mean()
    middle = process.steps // 2
    width = torch.special.ndtri(torch.tensor(0.95, dtype=torch.float64))  # of the central 90 %, in standard deviations
    return BeliefScores(
        (log_evidence(process, moment) - elbo(process, posterior, moment)).item(),
        expected_kl(_predictive(process, exact), _predictive(process, belief), moment).item(),
        expected_kl(belief, exact, moment).item(),
        nll.item(),
        (belief.variance / exact.variance)[middle].item(),
        torch.erf(width * (belief.variance / error)[middle].sqrt() / math.sqrt(2)).item(),
    )


def _predictive(process: ClosedFormProcess, belief: Conditional) -> Conditional:
    """Return the belief's densities of the next observation, p(o_t | belief at t - 1)."""
    before = _shift(process.steps)
    spread = process.transition**2 * before @ belief.variance + process.noise() + process.observation_noise  # (T,)
    return Conditional(belief.carry, process.transition * before @ belief.gain, spread)


def sample_gap(process: ClosedFormProcess, posterior: Conditional, samples: int, generator: torch.Generator) -> Tensor:
    """Sample o from the process and s from q(s | o); return log p(o) - log p(s, o) + log q(s | o) in nats, `(N,)`."""
    noise = torch.randn(3, process.steps, samples, generator=generator, dtype=torch.float64)
    state, observations = torch.zeros(samples, dtype=torch.float64), []
    for variance, step, seen in zip(process.noise(), *noise[:2], strict=True):
        state = process.transition * state + variance.sqrt() * step
        observations.append(state + math.sqrt(process.observation_noise) * seen)
    observation = torch.stack(observations, 1)  # (N, T)
    evidence = MultivariateNormal(torch.zeros_like(observation[0]), process.moment())
    gap: Tensor = evidence.log_prob(observation)  # (N,)
    state = torch.zeros_like(state)
    means = observation @ posterior.gain.T  # (N, T)
    for time, variance in enumerate(process.noise()):
        prior = Normal(process.transition * state, variance.sqrt())
        q = Normal(means[:, time] + posterior.carry[time] * state, posterior.variance[time].sqrt())
        state = q.mean + q.stddev * noise[2, time]
        likelihood = Normal(state, math.sqrt(process.observation_noise)).log_prob(observation[:, time])
        gap = gap + q.log_prob(state) - prior.log_prob(state) - likelihood
    return gap
