"""The scalar linear-Gaussian process: its evidence as one dense Gaussian, and what the paper's Theorem 1 misses."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal

from forbes.errors import ForbesError
from forbes.pomdps import LinearGaussian

SETTINGS = [(1.0, 1.0, 1.0), (1.0, 0.1, 1.0), (0.9, 0.3, 0.5)]  # F, Q, R
T = 15


def covariance_of_path(transition, noise, initial):
    """Cov(s_i, s_j) = F^|i-j| Var(s_min(i,j)), `(T, T)`."""
    variance = [initial]
    for _ in range(T - 1):
        variance.append(transition**2 * variance[-1] + noise)
    entries = [[transition ** abs(i - j) * variance[min(i, j)] for j in range(T)] for i in range(T)]
    return torch.tensor(entries, dtype=torch.float64)


def draw(process, sequences):
    return process.sample(sequences, T, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("initial", [1.0, 4.0])
def test_the_evidence_is_that_of_one_dense_gaussian(setting, initial):
    process = LinearGaussian(*setting, initial)
    _, observation, action = draw(process, 20)

    dense = covariance_of_path(*setting[:2], initial) + setting[2] * torch.eye(T, dtype=torch.float64)

    expected = MultivariateNormal(torch.zeros(T, dtype=torch.float64), dense).log_prob(observation[..., 0])
    torch.testing.assert_close(process.log_likelihood(observation, action), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("setting", "gap"), [(SETTINGS[0], 5.19), (SETTINGS[1], 32.6), (SETTINGS[2], 6.06)])
def test_the_exact_filter_as_posterior_has_the_known_gap(setting, gap):
    r"""E log p(o) - ELBO = E KL(∏ N(m_t, P_t) ‖ p(s | o)): zero by the paper's Theorem 1, which takes the filter for q.

    Both means are linear in the observations, so the expectation over them is a trace.
    """
    process = LinearGaussian(*setting)
    prior = covariance_of_path(*setting[:2], 1.0)
    dense = prior + setting[2] * torch.eye(T, dtype=torch.float64)
    precision = prior.inverse() + torch.eye(T, dtype=torch.float64) / setting[2]
    smoothed = prior @ dense.inverse()  # E[s | o] = smoothed o
    unit = torch.eye(T, dtype=torch.float64).unsqueeze(-1)  # (T, T, 1), an observation in each row

    belief = process.exact_filter(unit, torch.zeros(T, T, 0)).belief

    filtered, variance = belief.mean[..., 0].T, belief.variance[0, :, 0]  # (T, T), (T,)
    apart = filtered - smoothed
    kl = precision.diagonal() @ variance - T - precision.logdet() - variance.log().sum()
    kl += (precision @ apart @ dense @ apart.T).trace()
    assert kl.item() / 2 == pytest.approx(gap, abs=0.05 if gap > 10 else 0.005)  # as many digits as are known


@pytest.mark.parametrize("setting", SETTINGS)
def test_the_exact_smoothing_conditional_weighs_every_path_alike(setting):
    process = LinearGaussian(*setting)
    state, observation, action = draw(process, 8)

    exact = process.exact_smoothing_conditional(observation, action)

    # The true path is one that the posterior could have drawn; so is any other of the prior.
    for path in (state, state.flip(0)):
        joint = process.log_initial(path[:, 0]) + process.log_observation(observation, path).sum(1)
        joint += process.log_transition(path[:, 1:], path[:, :-1], action[:, 1:]).sum(1)
        before = torch.cat((torch.zeros_like(path[:, :1]), path[:, :-1]), 1)  # (B, T, 1)
        posterior = sum(exact.at(time, before[:, time]).log_prob(path[:, time]) for time in range(T))
        evidence = process.log_likelihood(observation, action)
        torch.testing.assert_close(joint - posterior, evidence, rtol=0, atol=1e-9)


def test_the_entropy_of_the_belief_is_that_of_its_variance():
    process = LinearGaussian()
    belief = process.exact_filter(*draw(process, 3)[1:]).belief

    golden = (math.sqrt(5) - 1) / 2  # the stationary variance: P = (P + 1) / (P + 2)
    assert belief.variance[0, -1].item() == pytest.approx(golden, abs=1e-10)
    torch.testing.assert_close(belief.entropy, 0.5 * (2 * math.pi * math.e * belief.variance[..., 0]).log())


@pytest.mark.parametrize("name", ["transition_variance", "observation_variance", "initial_variance"])
def test_a_variance_is_positive(name):
    with pytest.raises(ForbesError, match=f"^LinearGaussian: {name} is 0.0, expected more than 0"):
        LinearGaussian(**{name: 0.0})
