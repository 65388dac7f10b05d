"""The bound of a linear-Gaussian process, whose evidence is known exactly."""

import math

import pytest
import torch
from linear_gaussian import bounds, flow, gaussian, log_evidence, observations


@pytest.fixture(params=[gaussian, flow], ids=["gaussian", "flow"])
def process(request):
    return request.param()


@pytest.mark.parametrize("steps", [1, 3])
def test_bound_is_at_most_evidence_and_its_exp_averages_to_it(process, steps):
    (model, exact), samples = process, 20_000
    observation = observations(steps, seed=steps)
    torch.manual_seed(0)

    gap = bounds(model, observation, samples) - log_evidence(observation, *exact)

    assert gap.mean() <= 4 * gap.std() / math.sqrt(samples) + 1e-4  # 1e-4: the rounding of float32
    weight = gap.exp()  # p(o, s) / q(s) / p(o), whose mean is 1 for whatever q
    assert abs(weight.mean() - 1) < 4 * weight.std() / math.sqrt(samples) + 1e-4


def test_bound_is_the_evidence_when_the_posterior_is_exact():
    model, exact = gaussian()
    observation = observations(1, seed=0)

    each = bounds(model, observation, samples=100)

    torch.testing.assert_close(each, log_evidence(observation, *exact).expand(100), rtol=1e-5, atol=1e-5)


def test_bound_is_loose_if_later_observations_are_ignored():
    model, exact = gaussian()
    observation, samples = observations(3, seed=0), 20_000
    torch.manual_seed(0)

    gap = log_evidence(observation, *exact) - bounds(model, observation, samples)

    assert gap.mean() > 4 * gap.std() / math.sqrt(samples)
