"""P-values and bands are right for ranks, which are integers."""

import math

import pytest
import torch
from scipy import stats

from forbes.errors import ForbesError
from forbes.evaluation.calibration.uniformity import binomial_interval, ecdf_band, kolmogorov_smirnov, pearson, spread

LEVEL = 0.05


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def spread_kolmogorov_smirnov(ranks, samples):
    return kolmogorov_smirnov(spread(ranks, samples, generator(1)))


@pytest.mark.parametrize("samples", [9, 100])  # 10 ranks fill 10 bins, 101 do so unevenly
@pytest.mark.parametrize("count", [100, 200])
@pytest.mark.parametrize("test", [pearson, spread_kolmogorov_smirnov])
def test_the_rate_of_false_alarms_is_the_level(test, count, samples):
    repeats = 20_000
    ranks = torch.randint(samples + 1, (count, repeats), generator=generator())

    false_alarms = (test(ranks, samples) < LEVEL).double().mean()

    # 4 standard errors of a binomial share, and the limit that both p-values are: 0.0012 at 10 ranks a bin.
    assert abs(false_alarms - LEVEL) < 4 * math.sqrt(LEVEL * (1 - LEVEL) / repeats) + 0.0012


def test_without_its_spread_a_rank_has_no_right_p_value():
    ranks = torch.randint(10, (200, 1000), generator=generator())

    false_alarms = (kolmogorov_smirnov(ranks / 10) < LEVEL).double().mean()

    assert false_alarms > 0.5


@pytest.mark.parametrize(("count", "error"), [(50, 3e-4), (200, 1e-4), (1000, 3e-5)])
def test_kolmogorov_smirnov_is_the_exact_distribution(count, error):
    values = torch.rand(count, 200, generator=generator(), dtype=torch.float64) ** torch.linspace(0.7, 1.3, 200)

    p_values = kolmogorov_smirnov(values)

    exact = torch.tensor([stats.kstest(column, "uniform", method="exact").pvalue for column in values.T.numpy()])
    assert (exact < LEVEL).sum() > 20
    torch.testing.assert_close(p_values, exact, rtol=0, atol=error)


def test_values_that_are_too_even_are_no_alarm():
    even = (torch.arange(400, dtype=torch.float64) + 0.5) / 400

    assert kolmogorov_smirnov(even) == pytest.approx(1)


@pytest.mark.parametrize("samples", [9, 100])
def test_pearson_is_the_textbook_statistic(samples):
    ranks = (torch.rand(300, generator=generator()) ** 1.1 * (samples + 1)).long()
    of_bin = [[r for r in range(samples + 1) if r * 10 // (samples + 1) == b] for b in range(10)]
    observed = [sum((ranks == r).sum().item() for r in bin_) for bin_ in of_bin]
    expected = [300 * len(bin_) / (samples + 1) for bin_ in of_bin]

    p_value = pearson(ranks, samples)

    assert p_value.item() == pytest.approx(stats.chisquare(observed, expected).pvalue, rel=1e-10)


def test_columns_are_tested_on_their_own():
    ranks = torch.randint(101, (200, 2, 3), generator=generator())

    for test in (lambda r: pearson(r, 100), lambda r: kolmogorov_smirnov((r + 0.5) / 101)):
        assert test(ranks).shape == (2, 3)
        torch.testing.assert_close(test(ranks)[1, 2], test(ranks[:, 1, 2]))


@pytest.mark.parametrize("confidence", [0.5, 0.95])
@pytest.mark.parametrize("count", [1, 30, 1000])
def test_the_binomial_interval_is_that_of_the_quantiles(count, confidence):
    probability = torch.tensor([0.0, 0.03, 0.5, 0.9, 1.0], dtype=torch.float64)

    low, high = binomial_interval(count, probability, confidence)

    expected = [stats.binom.ppf((1 + side * confidence) / 2, count, probability.numpy()) for side in (-1, 1)]
    torch.testing.assert_close(count * low, torch.tensor(expected[0]))
    torch.testing.assert_close(count * high, torch.tensor(expected[1]))


@pytest.mark.parametrize(("count", "samples"), [(200, 20), (1000, 100)])
def test_the_band_holds_the_whole_distribution_function(count, samples):
    repeats = 4000
    low, high = ecdf_band(count, samples, 0.95, generator())

    ranks = torch.randint(samples + 1, (repeats, count), generator=generator(1))
    at_most = torch.stack([row.bincount(minlength=samples + 1) for row in ranks]).cumsum(1)[:, :-1] / count
    leaves = ((at_most < low - 1e-9) | (at_most > high + 1e-9)).any(1).double().mean()

    # 4 standard errors: of these repeats, and of the 2,000 simulations that set the band.
    assert abs(leaves - 0.05) < 4 * math.sqrt(0.05 * 0.95 * (1 / repeats + 1 / 2000))


@pytest.mark.parametrize(("count", "samples", "bins"), [(49, 100, 10), (200, 8, 10)])
def test_too_few_ranks_or_samples_are_one_sentence(count, samples, bins):
    ranks = torch.randint(samples + 1, (count,), generator=generator())

    with pytest.raises(
        ForbesError, match=rf"^pearson: {count} ranks among {samples} samples for {bins} bins, expected"
    ):
        pearson(ranks, samples, bins)
