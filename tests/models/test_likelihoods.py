"""The likelihoods against torch.distributions: fully normalised, summed over the image only."""

import pytest
import torch
from torch import distributions

from forbes.models import Bernoulli, Normal

SHAPE = (5, 3, 2, 4, 4)  # (B, T, C, H, W)


def images(high, dtype=torch.uint8):
    return torch.randint(high, SHAPE, generator=torch.Generator().manual_seed(0), dtype=dtype)


def output():
    return 3 * torch.randn(SHAPE, generator=torch.Generator().manual_seed(1))


def test_bernoulli_is_that_of_torch_distributions():
    likelihood = Bernoulli()
    target = likelihood.target(images(2))

    expected = distributions.Bernoulli(logits=output()).log_prob(target).sum((-3, -2, -1))

    torch.testing.assert_close(likelihood.log_prob(output(), target), expected)
    assert torch.equal(target, images(2).float())


@pytest.mark.parametrize("std", [0.1, 1.0])
def test_normal_is_that_of_torch_distributions(std):
    likelihood = Normal(std=std)
    target = likelihood.target(images(256))

    expected = distributions.Normal(output(), std).log_prob(target).sum((-3, -2, -1))

    torch.testing.assert_close(likelihood.log_prob(output(), target), expected)


@pytest.mark.parametrize("scale", [1.0, 255.0])
def test_normal_centres_stored_values_on_zero(scale):
    extremes = torch.tensor([0, int(scale)], dtype=torch.uint8)

    assert Normal(scale=scale).target(extremes).tolist() == [-0.5, 0.5]


@pytest.mark.parametrize(
    ("likelihood", "name"), [(Bernoulli(), "bernoulli"), (Normal(), "normal(1)"), (Normal(0.5), "normal(0.5)")]
)
def test_name_tells_the_densities_apart(likelihood, name):
    assert likelihood.name == name


@pytest.mark.parametrize("likelihood", [Bernoulli(), Normal()])
def test_mean_is_a_grey_value(likelihood):
    mean = likelihood.mean(output())

    assert mean.shape == SHAPE
    assert mean.min() >= 0
    assert mean.max() <= 1


def test_bernoulli_stays_exact_at_extreme_logits():
    logits, target = torch.tensor([1e4, -1e4]).view(2, 1, 1, 1), torch.tensor([0.0, 1.0]).view(2, 1, 1, 1)

    assert Bernoulli().log_prob(logits, target).tolist() == [-1e4, -1e4]
    assert Bernoulli().log_prob(logits, 1 - target).tolist() == [0, 0]
