"""The mirror sensor: one observation in closed form, and how far a Gaussian is from its belief."""

import math

import pytest
import torch
from torch.distributions import Normal

from forbes.errors import ForbesError
from forbes.pomdps import MirrorSensor


@pytest.fixture(scope="module", name="exact")
def exact_fixture():
    process = MirrorSensor(cells=401)
    _, observation, action = process.sample(400, 30, torch.Generator().manual_seed(0))
    return process.exact_filter(observation, action)


def test_one_observation_has_a_closed_form():
    r"""p(o) = 2 N(o; 0, 1 + σ²) Φ(o / (σ √(1 + σ²))): the folded normal, seen through noise."""
    process, noise = MirrorSensor(), 0.1
    observation = torch.tensor([-0.1, 0.0, 0.05, 0.4, 2.0], dtype=torch.float64)
    spread = math.sqrt(1 + noise**2)

    found = process.log_likelihood(observation[:, None, None], torch.zeros(5, 1, 0))

    standard = Normal(torch.zeros((), dtype=torch.float64), 1.0)
    expected = math.log(2 / spread) + standard.log_prob(observation / spread)
    expected += standard.cdf(observation / (noise * spread)).log()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)


def test_the_belief_is_symmetric():
    process = MirrorSensor(cells=801)
    _, observation, action = process.sample(10, 30, torch.Generator().manual_seed(0))

    belief = process.exact_filter(observation, action).belief

    # Up to the grid's error: it lies a fifth of a cell beside its mirror image.
    assert (belief.mean.abs() < 1e-3 * belief.variance.sqrt()).all()


def test_a_gaussian_of_the_same_moments_is_far_from_the_belief(exact):
    """KL(b ‖ N(mean, variance)) = log √(2πe variance) - H(b), and the mean of 4000 sequences is 1.160 ± 0.007."""
    belief = exact.belief
    divergence = 0.5 * (2 * math.pi * math.e * belief.variance[..., 0]).log() - belief.entropy  # (B, T)

    each = divergence.mean(1)
    error = math.hypot(each.std() / math.sqrt(len(each)), 0.007)
    assert abs(each.mean() - 1.160) < 4 * error


def test_the_evidence_has_its_known_mean(exact):
    """-5.78 ± 0.08 nats in the mean of 4000 sequences of 30 steps."""
    each = exact.log_likelihood

    error = math.hypot(each.std() / math.sqrt(len(each)), 0.08)
    assert abs(each.mean() + 5.78) < 4 * error


def test_a_belief_that_has_lost_a_mode_predicts_as_well():
    """Both halves of the belief give the same one-step prediction, so no prequential score can tell them apart."""
    process = MirrorSensor(cells=801)
    _, observation, action = process.sample(1, 5, torch.Generator().manual_seed(0))
    belief = process.exact_filter(observation, action).belief
    state = belief.sample(4000, torch.Generator().manual_seed(1))[:, :, -1]  # (4000, 1, 1)
    generator = torch.Generator().manual_seed(2)

    predicted = [process.transition(half, action[:, 0]).sample(1, generator)[0].abs() for half in (state, state.abs())]

    whole, half = (values.mean().item() for values in predicted)
    error = math.hypot(*(values.std().item() / math.sqrt(4000) for values in predicted))
    assert abs(whole - half) < 4 * error


@pytest.mark.parametrize(("name", "value"), [("observation_std", 0.0), ("cells", 1)])
def test_what_makes_no_sensor_is_one_sentence(name, value):
    with pytest.raises(ForbesError, match=f"^MirrorSensor: {name} is {value}, expected"):
        MirrorSensor(**{name: value})


def test_a_grid_too_coarse_for_the_noise_is_refused():
    """With a noise of 0.001, log p of ten steps was 5 nats off. From the width of a cell on, it is within 0.001."""
    with pytest.raises(ForbesError, match=r"a cell of its grid is 0\.0075 wide, expected at most observation_std"):
        MirrorSensor(observation_std=0.001)
    coarse, fine = MirrorSensor(0.0076), MirrorSensor(0.0076, cells=6401)
    _, observation, action = coarse.sample(20, 10, torch.Generator().manual_seed(0))

    found, expected = (process.log_likelihood(observation, action) for process in (coarse, fine))

    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)
