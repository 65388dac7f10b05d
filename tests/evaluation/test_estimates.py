"""Means over sequences and their errors, against sums by hand."""

import math

import pytest
import torch

from forbes.evaluation.estimates import Estimate, bootstrap_interval


def test_a_mean_has_the_standard_error_of_its_values():
    # By hand: mean 3; squares around it 4 + 1 + 4 + 9 = 18; √(18 / 3) / √4.
    assert Estimate.of(torch.tensor([1.0, 4.0, 1.0, 6.0])) == pytest.approx(Estimate(3.0, math.sqrt(6) / 2))


def test_nats_per_step_divide_all_nats_by_all_steps():
    total = torch.tensor([-10.0, -20.0, -60.0], dtype=torch.float64)

    estimate = Estimate.per_step(total, torch.tensor([2, 3, 5]))

    # By hand: -90 / 10; what each sequence is above -9 a step is 8, 7, -15, over 10 / 3 steps.
    assert estimate.mean == pytest.approx(-9.0)
    assert estimate.standard_error == pytest.approx(math.sqrt((8**2 + 7**2 + 15**2) / 2) * 0.3 / math.sqrt(3))


def test_bootstrap_interval_of_many_values_is_the_normal_one():
    values = torch.randn(4000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    low, high = bootstrap_interval(values)

    # The ends are quantiles of 1000 resampled means, each known to √(0.025 · 0.975 / 1000) / density(1.96) = 0.085
    # standard errors; 4 of these.
    mean, error = Estimate.of(values)
    assert low == pytest.approx(mean - 1.96 * error, abs=0.34 * error)
    assert high == pytest.approx(mean + 1.96 * error, abs=0.34 * error)


def copies(values, times):
    """Each value so many times in a row, and the number of the episode that the copies are of."""
    episodes = torch.arange(len(values)).repeat_interleave(torch.tensor(times)).tolist()
    return values[episodes], episodes


def test_copies_of_a_value_in_one_episode_make_nothing_more_certain():
    values = torch.randn(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    copied, episodes = copies(values, [7] * 50)
    steps = torch.full((350,), 10)

    assert Estimate.of(copied, episodes) == pytest.approx(Estimate.of(values))
    assert Estimate.per_step(copied, steps, episodes) == pytest.approx(Estimate.per_step(values, steps[:50]))
    assert bootstrap_interval(copied, episodes) == pytest.approx(bootstrap_interval(values))
    assert Estimate.of(copied).standard_error < 0.4 * Estimate.of(values).standard_error  # 1 / √7, as if independent


def test_episodes_may_have_different_numbers_of_sequences():
    """By hand: mean 3; sums of the deviations 2 · -2 and 4; √(2 / 1 · 32) / 3."""
    copied, episodes = copies(torch.tensor([1.0, 7.0]), [2, 1])

    assert Estimate.of(copied, episodes) == pytest.approx(Estimate(3.0, 8 / 3))


def test_an_episode_for_each_sequence_changes_nothing_and_of_one_nothing_is_known():
    values = torch.randn(20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    for episodes in (range(20), [3] * 20):
        assert Estimate.of(values, episodes) == pytest.approx(Estimate.of(values))
        assert bootstrap_interval(values, episodes) == pytest.approx(bootstrap_interval(values))
