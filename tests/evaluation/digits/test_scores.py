"""The scores of completions are their definitions, and proper where they claim to be."""

import itertools
import math

import pytest
import torch

from forbes.evaluation.digits.scores import (
    average_of,
    best_of,
    crps,
    energy_score,
    entropy,
    grey_ink,
    jensen_shannon,
    ratio_values,
)
from forbes.evaluation.estimates import Estimate

PIXELS = 5


def random(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_divergence_is_0_for_equal_and_log_2_for_disjoint():
    p = random(3, 10).softmax(-1)
    sure = torch.eye(10, dtype=torch.float64)

    torch.testing.assert_close(jensen_shannon(p, p), torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(jensen_shannon(sure[0], sure[1]), torch.tensor(math.log(2), dtype=torch.float64))
    q = p.flip(-1)
    torch.testing.assert_close(jensen_shannon(p, q), jensen_shannon(q, p))
    middle = (p + q) / 2
    kl = [(one * (one / middle).log()).sum(-1) for one in (p, q)]
    torch.testing.assert_close(jensen_shannon(p, q), (kl[0] + kl[1]) / 2)
    torch.testing.assert_close(entropy(torch.full((10,), 0.1)), torch.tensor(math.log(10)).double(), rtol=1e-7, atol=0)


def expectation(score, pictures, chance, truth, count):
    """Average a score over all tuples of `count` completions that are drawn from the pictures."""
    total = 0.0
    for tuple_ in itertools.product(range(len(pictures)), repeat=count):
        samples = pictures[list(tuple_)][:, None]  # (count, 1, P)
        total += math.prod(chance[k] for k in tuple_) * score(samples, truth[None]).item()
    return total


@pytest.mark.parametrize("count", [2, 3])
def test_the_energy_score_is_unbiased_for_any_sample_count(count):
    pictures, truth = (random(3, PIXELS) > 0.5).double(), torch.ones(PIXELS, dtype=torch.float64)
    chance = [0.2, 0.3, 0.5]

    weighted = list(zip(chance, pictures, strict=True))
    to_truth = sum(p * (x - truth).norm() for p, x in weighted)
    apart = sum(p * q * (x - y).norm() for p, x in weighted for q, y in weighted)

    found = expectation(energy_score, pictures, chance, truth, count)
    assert found == pytest.approx((to_truth - apart / 2).item(), rel=1e-9)


@pytest.mark.parametrize("count", [2, 3])
def test_crps_is_the_brier_score_of_the_mean_without_bias(count):
    pictures, truth = random(3, PIXELS), torch.tensor([0.0, 1.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    chance = [0.2, 0.3, 0.5]
    mean = sum(p * x for p, x in zip(chance, pictures, strict=True))

    found = expectation(crps, pictures, chance, truth, count)

    assert found == pytest.approx((mean - truth).square().sum().item(), rel=1e-9)


@pytest.mark.parametrize("score", [energy_score, crps])
def test_the_true_distribution_scores_best_in_expectation(score):
    """The truth is one picture with probability 0.3, else another; forecasts of it with every probability."""
    pictures = torch.tensor([[1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0]], dtype=torch.float64)
    forecasts = [k / 10 for k in range(11)]

    scores = [
        sum(p * expectation(score, pictures, [q, 1 - q], y, 2) for p, y in zip((0.3, 0.7), pictures, strict=True))
        for q in forecasts
    ]

    assert forecasts[scores.index(min(scores))] == 0.3


def test_the_best_and_the_average_of_n_are_those_of_all_subsets():
    means, truth = random(6, 2, PIXELS), (random(2, PIXELS) > 0.5).double()
    errors = (means - truth).square().sum(-1)  # (6, 2)

    best, average = best_of(errors), average_of(means, truth)

    for n in range(1, 7):
        subsets = [list(chosen) for chosen in itertools.combinations(range(6), n)]
        least = torch.stack([errors[chosen].amin(0) for chosen in subsets]).mean(0)
        mixed = torch.stack([(means[chosen].mean(0) - truth).square().sum(-1) for chosen in subsets]).mean(0)
        torch.testing.assert_close(best[:, n - 1], least)
        torch.testing.assert_close(average[:, n - 1], mixed)


def test_only_grey_ink_is_grey():
    assert grey_ink(torch.tensor([0.0, 1.0, 1.0])) == 0
    assert grey_ink(torch.tensor([0.05, 0.95])) == 0
    assert grey_ink(torch.tensor([0.5, 0.5, 1.0])) == 0.5
    assert grey_ink(torch.zeros(3)) == 0


def test_a_ratio_of_sums_has_the_error_of_a_ratio():
    part, whole = random(20), 1 + random(20)
    expected = Estimate.per_step(part, whole)

    found = Estimate.of(ratio_values(part, whole))

    assert found.mean == pytest.approx(expected.mean, rel=1e-12)
    assert found.standard_error == pytest.approx(expected.standard_error, rel=1e-12)
