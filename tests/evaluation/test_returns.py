"""Summaries of returns over tasks and seeds: their definitions, and how often the intervals are right."""

from itertools import product

import pytest
import torch
from torch.distributions import Normal

from forbes.evaluation.returns import aggregate, interquartile_mean, probability_of_improvement, stratified_interval

TRIALS = 200


def scores(generator, tasks, seeds, shift=0.0):
    """Normal scores of unit variance, around a mean that differs by task."""
    return [shift + 10 * k + torch.randn(seeds, generator=generator, dtype=torch.float64) for k in range(tasks)]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([5.0], 5.0),
        ([1.0, 2.0, 6.0], 3.0),
        ([100.0, 1.0, 3.0, -50.0], 2.0),  # a quarter of four is one on either side
        ([9.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, -9.0], 2.5),  # of eight, two
        ([-7.0, 1.0, 2.0, 3.0, 99.0], 2.0),  # of five, one
    ],
)
def test_the_interquartile_mean_of_known_lists(values, expected):
    assert interquartile_mean(torch.tensor(values, dtype=torch.float64)).item() == expected


def test_the_interquartile_mean_ignores_how_far_outliers_are():
    values = torch.arange(8, dtype=torch.float64)
    wild = values.clone()
    wild[[0, 1, 6, 7]] = torch.tensor([-1e9, -1e6, 1e6, 1e9], dtype=torch.float64)

    assert interquartile_mean(wild) == interquartile_mean(values)


def test_all_tasks_are_pooled():
    one, two = torch.tensor([0.0, 1.0]), torch.tensor([2.0, 30.0])

    assert aggregate([one, two]).item() == 1.5


def test_improvement_is_a_count_of_pairs():
    x = [torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.0, 5.0])]
    y = [torch.tensor([2.0, 2.5]), torch.tensor([5.0])]

    won = [[(a > b) + 0.5 * (a == b) for a, b in product(p.tolist(), q.tolist())] for p, q in zip(x, y, strict=True)]
    expected = sum(sum(each) / len(each) for each in won) / 2

    assert probability_of_improvement(x, y).item() == pytest.approx(expected, rel=1e-6)
    assert expected == (2.5 / 6 + 0.5 / 2) / 2


def test_both_directions_add_up_to_one_ties_included():
    generator = torch.Generator().manual_seed(0)
    x, y = ([torch.randint(4, (seeds,), generator=generator).double() for seeds in (3, 7)] for _ in range(2))

    there, back = probability_of_improvement(x, y), probability_of_improvement(y, x)

    assert (there + back).item() == pytest.approx(1, abs=1e-12)
    assert probability_of_improvement(x, x).item() == pytest.approx(0.5, abs=1e-12)


def test_resampling_stays_within_a_task():
    """Were it not so, the interval of these scores, which do not differ within a task, would have a width."""
    fixed = [torch.full((5,), float(task)) for task in (0, 10, 20, 30)]

    low, high = stratified_interval(aggregate, fixed)

    assert low == high == aggregate(fixed).item() == 15.0


def test_one_seed_has_no_interval():
    low, high = stratified_interval(aggregate, [torch.tensor([3.0])])

    assert low == high == 3.0


def trials(statistic, number, *shifts):
    """Return the intervals of a statistic in independent experiments of 3 tasks and 20 seeds."""
    generator = torch.Generator().manual_seed(1)
    return [
        stratified_interval(statistic, *(scores(generator, 3, 20, shift) for shift in shifts), seed=trial)
        for trial in range(number)
    ]


def share_around(value, intervals):
    return sum(low <= value <= high for low, high in intervals) / len(intervals)


def test_an_interval_of_the_iqm_covers_the_truth_and_excludes_a_wrong_one():
    """By symmetry the interquartile mean of all scores is near the mean of the middle task, 10.

    The variance of a resample of n seeds is (n - 1)/n of the variance that it estimates, so a nominal 95 % cover
    P(|Z| < 1.96 sqrt(19/20)) = 94.4 % to first order; the share of 200 experiments has a standard error of 1.6 %.
    """
    intervals = trials(aggregate, TRIALS, 0.0)

    expected = 2 * Normal(0.0, 1.0).cdf(torch.tensor(1.96 * (19 / 20) ** 0.5)).item() - 1
    error = (expected * (1 - expected) / TRIALS) ** 0.5
    assert abs(share_around(10, intervals) - expected) < 4 * error
    # The standard error of 30 scores in the middle is about 0.2, so 1 is five of them away.
    assert share_around(11, intervals) < 0.05


def test_an_interval_of_the_improvement_is_level_for_equals_and_not_for_others():
    """Scores of variance 1 that differ by 1 have P(X > Y) = Φ(1/√2) = 0.76."""
    expected = 2 * Normal(0.0, 1.0).cdf(torch.tensor(1.96 * (19 / 20) ** 0.5)).item() - 1
    error = (expected * (1 - expected) / TRIALS) ** 0.5

    assert abs(share_around(0.5, trials(probability_of_improvement, TRIALS, 0.0, 0.0)) - expected) < 4 * error
    better = trials(probability_of_improvement, TRIALS, 1.0, 0.0)
    true = Normal(0.0, 1.0).cdf(torch.tensor(0.5**0.5)).item()
    assert abs(share_around(true, better) - expected) < 4 * error
    assert sum(low > 0.5 for low, _ in better) / TRIALS > 0.95
