"""Calibration checks are silent about exact beliefs, and see the over-confidence that the ELBO prefers."""

import math

import pytest
import torch

from forbes.errors import ForbesError
from forbes.evaluation.calibration.ranks import coverage, ranks, tarp_ranks, two_sample_test
from forbes.evaluation.calibration.uniformity import kolmogorov_smirnov, pearson, spread
from forbes.evaluation.theorem import ClosedFormProcess, exact_filter, factorised_optimum, structured_optimum

LEVEL, SAMPLES = 0.05, 50
PROCESS = ClosedFormProcess(1.0, 1.0, 1.0, steps=15)
MIDDLE = 7


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def check(posterior_of, pairs, repeats, seed):
    """Draw states and observations of the process, hold a belief about the middle state, and rank.

    Gives the ranks of the state, of its log-density and of its distance from random points, `(pairs, repeats)` each.
    """
    belief, draw = posterior_of(PROCESS).marginal(), generator(seed)

    def noise(*shape):
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    state = noise(PROCESS.steps, pairs * repeats).cumsum(0)  # F = Q = P_1 = 1
    observation = state + noise(PROCESS.steps, pairs * repeats)  # R = 1
    mean, std = belief.gain[MIDDLE] @ observation, belief.variance[MIDDLE].sqrt()
    samples = mean + std * noise(SAMPLES + 1, pairs * repeats)
    density = torch.distributions.Normal(mean, std).log_prob
    truth = state[MIDDLE]
    of_value = ranks(truth, samples[1:], draw)
    of_density = ranks(density(truth), density(samples[1:]), draw)
    shape = (pairs, repeats)
    tarp = [
        tarp_ranks(one[:, None], some[..., None], draw)
        for one, some in zip(truth.view(shape).unbind(1), samples.view(-1, *shape).unbind(2), strict=True)
    ]
    return of_value.view(shape), of_density.view(shape), torch.stack(tarp, 1)


def rejections(checked, seed=1):
    """Share of the repeats in which a test says no: of each kind of rank by Pearson, and by Kolmogorov and Smirnov."""
    by_pearson = [(pearson(r, SAMPLES) < LEVEL).double().mean().item() for r in checked]
    by_ks = [(kolmogorov_smirnov(spread(r, SAMPLES, generator(seed))) < LEVEL).double().mean().item() for r in checked]
    return by_pearson, by_ks


def test_exact_beliefs_raise_five_false_alarms_in_a_hundred():
    parts = [rejections(check(exact_filter, pairs=200, repeats=500, seed=seed), seed + 10) for seed in range(5)]

    rates = torch.tensor(parts).mean(0)  # (2, 3), over 2,500 repeats: 1.5 % is 3.4 standard errors
    assert (rates - LEVEL).abs().max() < 0.015


@pytest.mark.parametrize(("optimum", "repeats"), [(factorised_optimum, 100), (structured_optimum, 300)])
def test_the_over_confidence_of_the_elbos_optimum_is_seen(optimum, repeats):
    by_pearson, by_ks = rejections(check(optimum, pairs=1000, repeats=repeats, seed=0))

    (values, densities, tarp), (values_ks, densities_ks, tarp_ks) = by_pearson, by_ks
    assert min(values, densities, densities_ks) > 0.99
    # Of the structured optimum, which covers 83.0 %, these see 95 cases in 100; of the other, 76.4 %, all.
    assert min(tarp, values_ks, tarp_ks) > (0.99 if optimum is factorised_optimum else 0.9)


@pytest.mark.parametrize(("posterior_of", "covered"), [(exact_filter, 0.9), (factorised_optimum, 0.764)])
def test_coverage_is_the_closed_form(posterior_of, covered):
    pairs = 20_000
    _, of_density, _ = check(posterior_of, pairs, 1, seed=0)

    shares = coverage(of_density[:, 0], SAMPLES, torch.tensor([0.0, 0.9, 1.0]))

    # The region of 50 samples is itself random, which moves its coverage where it is curved: by less than 1 / L.
    slack = 0 if covered == 0.9 else 0.002
    assert abs(shares[1] - covered) < 4 * math.sqrt(covered * (1 - covered) / pairs) + slack
    assert shares.tolist()[::2] == [0, 1]


def test_evenly_spread_ranks_cover_each_level_exactly():
    levels = torch.linspace(0, 1, 33, dtype=torch.float64)

    torch.testing.assert_close(coverage(torch.arange(11), 10, levels), levels)


def test_coverage_counts_the_samples_of_higher_density():
    # 4 samples: the truth is the densest of 5 in the first pair, the least dense in the second.
    levels = torch.tensor([0.2, 0.8, 0.9], dtype=torch.float64)
    torch.testing.assert_close(coverage(torch.tensor([4]), 4, levels), torch.tensor([1.0, 1, 1]).double())
    torch.testing.assert_close(coverage(torch.tensor([0]), 4, levels), torch.tensor([0.0, 0, 0.5]).double())
    torch.testing.assert_close(coverage(torch.tensor([4, 0]), 4, levels), torch.tensor([0.5, 0.5, 0.75]).double())


def test_ranks_count_the_samples_below():
    samples = torch.tensor([[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]])[:, None]  # (3, 1, 2)

    assert ranks(torch.tensor([[1.5, 9.0]]), samples, generator()).tolist() == [[2, 3]]
    assert ranks(torch.tensor([[-1.0, 3.5]]), samples, generator()).tolist() == [[0, 1]]


def test_ties_are_broken_fairly():
    pairs, categories = 20_000, 3
    draws = torch.randint(categories, (10, pairs), generator=generator())  # the truth and 9 samples, many of them equal

    counts = ranks(draws[0], draws[1:], generator(1)).bincount(minlength=10)

    assert len(counts) == 10
    assert (counts / pairs - 0.1).abs().max() < 4 * math.sqrt(0.1 * 0.9 / pairs)


def test_a_truth_without_density_has_the_lowest_rank():
    density = torch.full((1,), -torch.inf)

    assert ranks(density, torch.zeros(5, 1), generator()).tolist() == [0]


def test_tarp_ranks_use_distances_from_a_left_out_sample():
    samples = torch.tensor([[[0.0, 0.0], [4.0, 2.0]], [[1.0, 0.0], [0.0, 1.0]], [[5.0, 2.0], [3.0, 0.0]]]).double()
    truth = torch.tensor([[4.0, 1.0], [0.0, 0.5]]).double()

    # Points (4, 2) and (0, 0); the scale, of 0, 4 and of 0, 2, is 2 to 1. Squared distances in units of the second
    # dimension's scale: the first pair (0 + 1) of 2.25 + 4 and 0.25 + 0; the second 0.25 of 1 and 2.25.
    assert tarp_ranks(truth, samples, generator()).tolist() == [1, 0]


def test_tarp_does_not_depend_on_units():
    truth, samples, unit = normal(50, 3), normal(20, 50, 3, seed=1), torch.tensor([1e-6, 1.0, 1e6]).double()

    plain = tarp_ranks(truth, samples, generator())

    assert torch.equal(tarp_ranks(truth * unit, samples * unit, generator()), plain)


def test_tarp_sees_a_correlation_that_marginal_ranks_miss():
    mixing = torch.linalg.cholesky(torch.tensor([[1.0, 0.8], [0.8, 1.0]]).double()).T
    truth, samples = normal(1000, 2) @ mixing, normal(SAMPLES + 1, 1000, 2, seed=1)

    ignored = pearson(tarp_ranks(truth, samples, generator()), SAMPLES)
    known = pearson(tarp_ranks(truth, samples @ mixing, generator()), SAMPLES)

    assert (pearson(ranks(truth, samples[1:], generator()), SAMPLES) > LEVEL).all()
    assert ignored < 1e-3
    assert known > LEVEL


def held(count, width, seed):
    """True values about whose mean a belief N(mean, width²) is held, two-dimensional, and 40 samples of it."""
    draw = generator(seed)
    mean, truth, samples = (
        torch.randn(*shape, count, 2, generator=draw, dtype=torch.float64) for shape in [(), (), (40,)]
    )
    return mean + truth, mean + width * samples, draw


def two_sample_tests(count, width, repeats, permutations=99):
    """P-values and accuracies, `(repeats,)`."""
    tests = [two_sample_test(*held(count, width, seed), permutations=permutations) for seed in range(repeats)]
    return torch.tensor([test.p_value for test in tests]), torch.tensor([test.accuracy for test in tests])


def test_exact_beliefs_are_rejected_as_often_as_the_level_says():
    repeats = 400

    p_value, accuracy = two_sample_tests(count=100, width=1.0, repeats=repeats)

    assert abs(accuracy.mean() - 0.5) < 4 * accuracy.std() / math.sqrt(repeats)
    # The accuracy is a number of 200 answers, its deviation 8 of them; exchanges that are as good count as better.
    for level, tied in ((LEVEL, 0.01), (0.5, 0.05)):
        noise = 3 * math.sqrt(level * (1 - level) / repeats)
        assert -noise - tied < (p_value <= level + 1e-9).double().mean() - level < noise


def test_beliefs_that_are_too_narrow_are_told_apart():
    twenty_percent, _ = two_sample_tests(count=1000, width=0.8, repeats=20, permutations=39)
    thirty_percent, accuracy = two_sample_tests(count=1000, width=0.7, repeats=10, permutations=39)

    assert (twenty_percent <= LEVEL).double().mean() >= 0.8  # of 200 cases 98 in 100
    assert (thirty_percent <= LEVEL).all()
    assert accuracy.min() > 0.55


def test_two_values_of_one_pair_never_judge_each_other():
    """Beliefs whose means lie far apart: a value's nearest neighbour by far is its twin, of the other label."""
    mean = 100 * torch.arange(40, dtype=torch.float64)[:, None]
    samples = mean + normal(40, 40, 1)

    accuracy, p_value = two_sample_test(mean + normal(40, 1, seed=1), samples, generator())

    assert abs(accuracy - 0.5) < 4 / math.sqrt(4 * 80)
    assert p_value > 0.01


def test_accuracy_on_two_gaussians_is_close_to_the_best():
    samples = torch.cat((normal(1, 1000, 1, seed=1) + 2, torch.zeros(1, 1000, 1)))  # nothing is known beside the values

    accuracy, p_value = two_sample_test(normal(1000, 1), samples, generator(), permutations=99)

    best = torch.special.ndtr(torch.tensor(1.0)).item()  # the border lies at 1
    assert best - 0.02 < accuracy < best + 4 * math.sqrt(best * (1 - best) / 2000)
    assert p_value == 0.01


def test_a_missing_mode_is_seen_despite_a_constant_dimension():
    sign = torch.where(normal(400, 1) > 0, 1.0, -1.0)
    truth = torch.cat((3 * sign + normal(400, 1, seed=1), torch.ones(400, 1)), 1)
    sample = torch.cat((3 + normal(400, 1, seed=2), torch.ones(400, 1)), 1)

    accuracy, p_value = two_sample_test(truth, torch.stack((sample, 0 * sample)), generator(), permutations=99)

    assert accuracy == pytest.approx(0.75, abs=4 * math.sqrt(0.75 * 0.25 / 800))  # half of the truths are alone
    assert p_value == 0.01


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (
            lambda g: ranks(normal(3, 2), normal(9, 2, 3), g),
            r"^ranks: samples have shape \(9, 2, 3\) and true values \(3, 2\)",
        ),
        (lambda g: ranks(normal(3).log(), normal(9, 3), g), r"^ranks: there are NaN"),
        (lambda g: tarp_ranks(normal(3, 2), normal(9, 3, 1), g), r"^tarp_ranks: samples have shape \(9, 3, 1\)"),
        (lambda g: tarp_ranks(normal(3, 2), normal(1, 3, 2), g), "^tarp_ranks: 3 pairs with 1 samples"),
        (lambda g: tarp_ranks(normal(1, 2), normal(9, 1, 2), g), "^tarp_ranks: 1 pairs with 9 samples"),
        (lambda g: tarp_ranks(normal(3, 2) / 0, normal(9, 3, 2), g), "^tarp_ranks: there are infinite values"),
        (
            lambda g: two_sample_test(normal(30, 2), normal(9, 30, 3), g),
            r"^two_sample_test: samples have shape \(9, 30",
        ),
        (lambda g: two_sample_test(normal(9, 2), normal(9, 9, 2), g), "^two_sample_test: 9 pairs with 9 samples"),
        (lambda g: two_sample_test(normal(30, 2), normal(1, 30, 2), g), "^two_sample_test: 30 pairs with 1 samples"),
        (lambda g: two_sample_test(normal(30, 2), normal(9, 30, 2).log(), g), "^two_sample_test: there are NaN"),
    ],
)
def test_what_cannot_be_checked_is_one_sentence(call, expected):
    with pytest.raises(ForbesError, match=expected):
        call(generator())
