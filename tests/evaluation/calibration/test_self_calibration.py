"""Checked against itself, an exact filter is calibrated, and one that is too narrow is caught."""

import pytest
import torch
from linear_gaussian import gaussian

from forbes.evaluation.calibration.ranks import coverage
from forbes.evaluation.calibration.self_calibration import self_calibration
from forbes.evaluation.calibration.uniformity import pearson

SAMPLES, SEQUENCES = 39, 2000
FIRST_STEP = torch.zeros(SEQUENCES, 1, 0)  # where p(s_1 | o_1), this filter, is exact


def p_values(found):
    ranks = torch.cat((found.value, found.density[:, None], found.tarp[:, None]), 1)
    return pearson(ranks, SAMPLES)


@pytest.mark.parametrize("seed", range(3))
def test_an_exact_filter_is_calibrated(seed):
    model, _ = gaussian()

    found = self_calibration(model, FIRST_STEP, SAMPLES, seed)

    assert found.value.shape == (SEQUENCES, 2)
    assert p_values(found).min() > 1e-3 / 4  # four tests, one in a thousand together
    assert found.classifier.p_value > 1 / 200  # the smallest that 199 permutations can give


def test_a_too_narrow_filter_is_caught_and_covers_too_little():
    model, _ = gaussian()
    with torch.no_grad():
        model.posterior.parameters_of.bias[2:] -= 0.7  # of softplus(·): about half the spread

    found = self_calibration(model, FIRST_STEP, SAMPLES)

    assert p_values(found).max() < 1e-6
    assert found.classifier.p_value == 1 / 200
    assert coverage(found.density, SAMPLES, torch.tensor([0.9])) < 0.8


def test_weights_make_a_calibrated_belief_of_a_wrong_posterior():
    model, _ = gaussian()
    with torch.no_grad():
        model.posterior.parameters_of.bias[2:] += 0.7  # of softplus(·): nearly twice the spread
    steps = torch.zeros(SEQUENCES, 3, 0)

    trajectory = self_calibration(model, steps, SAMPLES)
    weighted = self_calibration(model, steps, SAMPLES, particles=32)

    assert p_values(trajectory).max() < 1e-6
    assert p_values(weighted).min() > 1e-3 / 4
    assert weighted.classifier.p_value > 1 / 200


def test_depends_on_the_seed_alone_and_leaves_the_random_state():
    model, _ = gaussian()
    before = torch.get_rng_state()

    first, again = (self_calibration(model, FIRST_STEP[:50], SAMPLES, seed=1) for _ in range(2))

    assert all(torch.equal(a, b) for a, b in zip(first[:3], again[:3], strict=True))
    assert first.classifier == again.classifier
    assert torch.equal(torch.get_rng_state(), before)
