"""The exact beliefs: each density integrates to one, its samples follow it, and its moments are its own."""

import math

import pytest
import torch
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from forbes.pomdps import FiniteBelief, GaussianMixtureBelief, GridBelief


def random(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mixture(*shape, components=3, dim=2):
    scale = random(*shape, dim, dim, seed=2)
    covariance = scale @ scale.mT + 0.1 * torch.eye(dim)
    log_weight = random(*shape, components).log_softmax(-1)
    return GaussianMixtureBelief(log_weight, 2 * random(*shape, components, dim, seed=1), covariance)


def grid(*shape, cells=50):
    return GridBelief(random(*shape, cells).log_softmax(-1), random(*shape, seed=1), 0.1)


def categorical(*shape, values=5):
    log_mass = random(*shape, values)
    log_mass[..., 0] = -torch.inf  # impossible values are allowed
    return FiniteBelief(log_mass.log_softmax(-1))


BELIEFS = {"gaussian": lambda *shape: mixture(*shape, components=1), "mixture": mixture, "grid": grid}
BELIEFS["categorical"] = categorical


@pytest.fixture(params=BELIEFS, name="make")
def make_fixture(request):
    return BELIEFS[request.param]


def test_samples_have_the_moments_and_the_entropy_that_are_given(make):
    belief, count = make(2, 3), 40_000

    sample = belief.sample(count, torch.Generator().manual_seed(0))  # (count, 2, 3, D)

    def assert_mean(values, expected):
        assert ((values.mean(0) - expected).abs() <= 4 * values.std(0) / math.sqrt(count) + 1e-12).all()

    assert_mean(sample, belief.mean)
    assert_mean((sample - belief.mean).square(), belief.variance)
    if belief.entropy is not None:
        assert belief.entropy.shape == (2, 3)
        assert_mean(-belief.log_prob(sample), belief.entropy)


def test_samples_are_a_function_of_the_generator(make):
    belief = make(2, 3)
    first, again, other = (belief.sample(5, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))

    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_every_belief_is_drawn_from_its_own_row(make):
    belief = make(4)

    sample = belief.sample(5000, torch.Generator().manual_seed(0))  # (5000, 4, D)

    own, other = belief.log_prob(sample), belief.log_prob(sample.roll(1, 1))
    assert (own.mean(0) > other.mean(0)).all()  # Gibbs' inequality


def test_only_a_mixture_of_several_has_no_entropy():
    assert mixture(2).entropy is None
    expected = MultivariateNormal(torch.zeros(2, 2, dtype=torch.float64), mixture(2, components=1).covariance).entropy()
    torch.testing.assert_close(mixture(2, components=1).entropy, expected)


def test_a_mixture_is_that_of_torch_distributions():
    belief = mixture(2, 3)
    oracle = MixtureSameFamily(
        Categorical(logits=belief.log_weight),
        MultivariateNormal(belief.component_mean, belief.covariance.unsqueeze(-3)),
    )
    value = random(7, 2, 3, 2, seed=5)

    torch.testing.assert_close(belief.log_prob(value), oracle.log_prob(value))
    torch.testing.assert_close(belief.mean, oracle.mean)
    torch.testing.assert_close(belief.variance, oracle.variance)


def test_a_mixture_is_differentiable_in_the_state():
    value = random(4, 2, seed=5).requires_grad_()

    assert torch.autograd.gradcheck(mixture(4).log_prob, value)


def test_a_grid_density_integrates_to_one_and_is_zero_outside():
    belief = grid(2, 3)
    low, width = belief.centres[..., :1] - 0.05, 0.1  # (2, 3, 1)
    within = (torch.arange(200, dtype=torch.float64) + 0.5) / 4  # four points in each cell, (200,)

    value = (low + width * within).permute(2, 0, 1).unsqueeze(-1)  # (200, 2, 3, 1)
    density = belief.log_prob(value).exp()

    torch.testing.assert_close(density.sum(0) * width / 4, torch.ones(2, 3, dtype=torch.float64), rtol=0, atol=1e-13)
    torch.testing.assert_close(density[::4], belief.log_mass.exp().permute(2, 0, 1) / width)
    for outside in (low - 1e-9, low + 50 * width + 1e-9):
        assert belief.log_prob(outside).isneginf().all()


def test_samples_of_a_grid_follow_its_distribution_function():
    belief, count = grid(), 20_000

    sample = belief.sample(count, torch.Generator().manual_seed(0))[:, 0]

    # A piecewise constant density has a piecewise linear distribution function: at the edges and within the cells.
    points = (belief.centres.unsqueeze(1) + torch.tensor([-0.025, 0.0, 0.025, 0.05])).flatten()  # (4 G,)
    mass = belief.log_mass.exp()
    below = mass.cumsum(0) - mass  # (G,)
    expected = (below.unsqueeze(1) + mass.unsqueeze(1) * torch.tensor([0.25, 0.5, 0.75, 1.0])).flatten()  # (4 G,)
    observed = torch.searchsorted(sample.sort().values, points, right=True) / count
    # Kolmogorov-Smirnov: exceeded with probability 1e-4.
    limit = math.sqrt(-math.log(1e-4 / 2) / (2 * count))
    assert (observed - expected).abs().max() < limit
    # And where in its cell a sample lies, for all cells at once.
    place = ((sample - belief.centres[0]) / 0.1 + 0.5) % 1
    uniform = (torch.arange(count) + 0.5) / count
    assert (place.sort().values - uniform).abs().max() < limit


def test_probabilities_of_one_hot_values_add_up_to_one():
    belief = categorical(3, values=5)

    probability = belief.log_prob(torch.eye(5, dtype=torch.float64).unsqueeze(1)).exp()  # (5, 3)

    torch.testing.assert_close(probability.sum(0), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(probability.T, belief.mean)
    assert not probability[0].any()
