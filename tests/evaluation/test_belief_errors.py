"""The errors of a belief: zero of the exact one, and equal to closed forms where there are any."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal, kl_divergence

from forbes.evaluation.belief_errors import ERRORS, belief_errors, mode_centres, moment_matched
from forbes.pomdps import GaussianMixtureBelief, GridBelief, LightDark, LinearGaussian, MirrorSensor, MountainHike, Ungm

PROCESSES = {
    "linear_gaussian": LinearGaussian(),
    "mirror_sensor": MirrorSensor(cells=401),
    "ungm": Ungm(cells=451),
    "light_dark": LightDark(cells_per_step=10),
    "multi_start_hike": MountainHike("multi", observation_std=1.5),
}
MANY = 4000  # beliefs, all alike: the spread of their estimates gives the error of the mean


def drawn(process, sequences=20, steps=8):
    state, observation, action = process.sample(sequences, steps, torch.Generator().manual_seed(0))
    return state, process.exact_filter(observation, action).belief


def errors_of(exact, belief, state, modes=None, samples=50, seed=0):
    return belief_errors(exact, belief, state, modes, samples, torch.Generator().manual_seed(seed))


def mixture(weight, means, covariance, copies=MANY):
    """Copies of a mixture, `(copies, 1)`."""
    log_weight, means, covariance = (
        torch.tensor(values, dtype=torch.float64) for values in (weight, means, covariance)
    )
    shape = (copies, 1)
    return GaussianMixtureBelief(log_weight.log().expand(*shape, -1), means.expand(*shape, -1, -1), covariance)


def on_grid(belief, half=12.0, cells=2401):
    """The same scalar belief in cells."""
    centres = torch.linspace(-half, half, cells, dtype=torch.float64)
    log_density = belief.log_prob(centres.view(-1, 1, 1, 1)).movedim(0, -1)  # (B, T, G)
    width = 2 * half / (cells - 1)
    return GridBelief(log_density + math.log(width), -half, width)


def assert_mean(values, expected, exactly=0.0):
    """The mean over copies is the expected one, within four standard errors."""
    assert abs(values.mean() - expected) < 4 * values.std() / math.sqrt(len(values)) + exactly


@pytest.mark.parametrize("process", PROCESSES.values(), ids=PROCESSES)
def test_the_exact_belief_has_no_error(process):
    state, exact = drawn(process)
    modes = mode_centres(process)

    found = errors_of(exact, exact, state, modes)

    assert list(found) == [name for name in ERRORS if name != "mode_mass_error" or modes is not None]
    for name, values in found.items():
        expected = torch.full(state.shape[:2], float(name == "variance_ratio"), dtype=torch.float64)
        torch.testing.assert_close(values, expected, rtol=0, atol=1e-12)


PLANE = (
    ([1.0], [[0.3, -0.2]], [[0.5, 0.2], [0.2, 0.4]]),
    ([1.0], [[0.0, 0.0]], [[0.8, -0.1], [-0.1, 0.6]]),
)
LINE = (([1.0], [[0.5]], [[0.6]]), ([1.0], [[0.0]], [[1.1]]))


@pytest.mark.parametrize(("first", "second"), [LINE, LINE[::-1], PLANE, PLANE[::-1]])
def test_between_gaussians_they_are_the_closed_forms(first, second):
    exact, belief = mixture(*first), mixture(*second)
    p, q = (MultivariateNormal(one.mean[0, 0], one.covariance) for one in (exact, belief))

    found = errors_of(exact, belief, exact.mean)

    assert_mean(found["forward_kl"], kl_divergence(p, q))
    assert_mean(found["reverse_kl"], kl_divergence(q, p))
    expected = q.covariance_matrix.trace() / p.covariance_matrix.trace()
    of_ratio = expected / 50  # its bias, of the order of one over the samples
    assert_mean(found["variance_ratio"], expected, exactly=of_ratio)
    torch.testing.assert_close(found["state_nll_regret"], (p.log_prob(p.mean) - q.log_prob(p.mean)).expand(MANY, 1))


def test_on_a_grid_they_are_the_closed_forms_without_noise():
    """The midpoint rule's error for Gaussians vanishes faster than any power of the width."""
    exact, belief = (mixture(*one, copies=1) for one in LINE)
    p, q = (MultivariateNormal(one.mean[0, 0], one.covariance) for one in (exact, belief))

    found = errors_of(on_grid(exact), belief, exact.mean)

    for name, expected in [
        ("forward_kl", kl_divergence(p, q)),
        ("reverse_kl", kl_divergence(q, p)),
        ("variance_ratio", q.covariance_matrix[0, 0] / p.covariance_matrix[0, 0]),
    ]:
        torch.testing.assert_close(found[name], expected.expand(1, 1), rtol=0, atol=1e-9)


def test_a_mode_that_is_too_heavy_is_an_error_of_its_excess():
    means, narrow, modes = [[-3.0], [3.0]], [[0.01]], torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    exact, belief = mixture([0.5, 0.5], means, narrow), mixture([0.9, 0.1], means, narrow)
    one_exact, one_belief = mixture([0.5, 0.5], means, narrow, 1), mixture([0.9, 0.1], means, narrow, 1)

    by_samples = errors_of(exact, belief, exact.mean, modes)["mode_mass_error"]
    by_cells = errors_of(on_grid(one_exact), one_belief, one_exact.mean, modes)["mode_mass_error"]

    assert_mean(by_samples, 0.4)
    torch.testing.assert_close(by_cells, torch.tensor([[0.4]], dtype=torch.float64), rtol=0, atol=1e-9)


def test_a_matched_gaussian_keeps_the_masses_but_is_far_away():
    """1.160 ± 0.007 nats is the forward KL in the mean of 4000 sequences of 30 steps."""
    process = MirrorSensor(cells=801)
    state, exact = drawn(process, sequences=100, steps=30)

    matched = moment_matched(exact)

    found = errors_of(exact, matched, state, mode_centres(process))

    each, regret = found["forward_kl"].mean(1), found["state_nll_regret"].mean(1)  # (B,), (B,)
    assert abs(each.mean() - 1.160) < 4 * math.hypot(each.std() / 10, 0.007)
    assert abs((regret - each).mean()) < 4 * (regret - each).std() / 10  # the proper score has the KL as its mean
    at_zero = sum(one.log_prob(torch.zeros_like(state)).exp() for one in (exact, matched))  # (B, T)
    # A cell at zero belongs to one side; and the exact belief's mean may be 2e-3 of its deviation beside zero.
    assert (found["mode_mass_error"] < exact.width * at_zero + 2e-3).all()


def test_a_lost_mode_costs_much_one_way_and_log_two_the_other():
    means, narrow = [[-3.0], [3.0]], [[0.01]]
    exact, belief = mixture([0.5, 0.5], means, narrow, copies=1), mixture([1.0], [[3.0]], narrow, copies=1)

    found = errors_of(on_grid(exact), belief, exact.mean)

    assert found["reverse_kl"].item() == pytest.approx(math.log(2), rel=1e-9)
    # Half of the states are 60 standard deviations from q's mode: E[(s - 3)² - (s + 3)²] / (2 σ²) / 2 = 900.
    assert found["forward_kl"].item() == pytest.approx(900 - math.log(2), rel=1e-9)


def test_the_gaussian_of_the_same_moments_has_them():
    _, exact = drawn(PROCESSES["multi_start_hike"])
    matched = moment_matched(exact)
    torch.testing.assert_close(matched.mean, exact.mean)
    torch.testing.assert_close(matched.variance, exact.variance)


def test_mass_outside_of_the_grid_is_no_negative_divergence():
    """q = (p + a Gaussian far outside) / 2. Given the grid it is p, so that KL(q ‖ p) is 0, where it was -log 2."""
    exact = mixture([1.0], [[0.0]], [[1.0]], copies=1)
    other = mixture([0.5, 0.5], [[0.0], [40.0]], [[1.0]], copies=1)

    found = errors_of(on_grid(exact), other, exact.mean)

    torch.testing.assert_close(found["reverse_kl"], torch.zeros(1, 1, dtype=torch.float64), rtol=0, atol=1e-9)
    torch.testing.assert_close(found["forward_kl"], torch.full((1, 1), math.log(2), dtype=torch.float64))
