"""The likelihoods against torch.distributions: fully normalised, summed over the image only."""

import pytest
import torch
from torch import distributions

from forbes.errors import ForbesError
from forbes.models import Bernoulli, Normal, OneHot, OnePixel, SymlogNormal, VectorNormal
from forbes.symlog import symlog

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


def each_pixel(channels=2, side=3):
    """Every observation of at most one pixel, none first: `(C H W + 1, C, H, W)`."""
    pixels = torch.eye(channels * side * side).view(-1, channels, side, side)
    return torch.cat((torch.zeros_like(pixels[:1]), pixels)).byte()


def test_one_pixel_is_a_softmax_with_none_at_zero():
    likelihood, observation = OnePixel(), each_pixel()
    logits = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    log_prob = likelihood.log_prob(logits, likelihood.target(observation))

    all_logits = torch.cat((torch.zeros(1, dtype=torch.float64), logits.flatten()))
    torch.testing.assert_close(log_prob, distributions.Categorical(logits=all_logits).logits)
    torch.testing.assert_close(log_prob.exp().sum().item(), 1.0)
    torch.testing.assert_close(likelihood.mean(logits).flatten(), log_prob[1:].exp())


def test_one_pixel_draws_what_it_gives_probability_to():
    likelihood, number = OnePixel(), 20_000
    logits = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.manual_seed(0)

    drawn = likelihood.sample(logits.expand(number, -1, -1, -1))

    assert drawn.flatten(1).sum(1).max() == 1
    share, expected = drawn.mean(0), likelihood.mean(logits)
    # Each share is binomial; of 18, the largest of |z| exceeds 4.5 with probability 1.2e-4.
    assert ((share - expected) / (expected * (1 - expected) / number).sqrt()).abs().max() < 4.5


@pytest.mark.parametrize(
    ("likelihood", "observation", "message"),
    [
        (OnePixel(), torch.ones(2, 1, 3, 3, dtype=torch.uint8), "a frame has 9 pixels that are on, expected at most 1"),
        (OnePixel(), torch.full((2, 1, 1, 1), 255, dtype=torch.uint8), "OnePixel: observations have values from 255"),
        (Bernoulli(), torch.full((2, 1, 1, 1), 7, dtype=torch.uint8), "values from 7 to 7, expected 0 and 1"),
        (Bernoulli(), torch.full((2, 1, 1, 1), -1.0), "values from -1 to -1, expected 0 and 1"),
        (Bernoulli(), torch.full((2, 1, 1, 1), torch.nan), "values from nan to nan, expected 0 and 1"),
        (OneHot(), torch.tensor([[1.0, 0.0], [0.0, 0.0]]), "observations are not one-hot"),
        (OneHot(), torch.tensor([[1.0, 1.0]]), "observations are not one-hot"),
        (OneHot(), torch.tensor([[0.5, 0.5]]), "observations are not one-hot"),
    ],
)
def test_observations_without_a_density_are_refused(likelihood, observation, message):
    with pytest.raises(ForbesError, match=message):
        likelihood.check(observation)


def test_observations_with_a_density_pass():
    OnePixel().check(each_pixel())
    Bernoulli().check(images(2))
    Normal().check(images(256))
    OneHot().check(torch.eye(3))


@pytest.mark.parametrize("std", [0.0, -1.0, torch.nan])
def test_a_spread_that_is_none_is_refused(std):
    for kind in (Normal, VectorNormal, SymlogNormal):
        with pytest.raises(ForbesError, match=f"{kind.__name__}: std is {std}, expected more than 0"):
            kind(std=std)


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
    ("likelihood", "name"),
    [
        (Bernoulli(), "bernoulli"),
        (Normal(), "normal(1)"),
        (Normal(0.5), "normal(0.5)"),
        (Normal(scale=1), "normal(1,scale=1)"),
    ],
)
def test_name_tells_the_densities_apart(likelihood, name):
    assert likelihood.name == name


@pytest.mark.parametrize("bits", [1, 5, 7])
def test_fewer_bits_keep_the_leading_ones_and_add_noise(bits):
    """Uniform within its step, a byte is known to lie there and no better: mean and spread are those of the step."""
    bytes_ = torch.arange(256, dtype=torch.uint8)
    torch.manual_seed(0)
    readings = Normal(bits=bits).target(bytes_.expand(2000, -1)) + 0.5  # (2000, 256)

    step = 2.0**-bits
    floor = (bytes_ >> (8 - bits)).float() * step
    assert ((readings >= floor) & (readings <= floor + step)).all()  # the upper end by rounding only
    error = step / 12**0.5 / 2000**0.5  # of a mean of 2,000 uniform numbers
    torch.testing.assert_close(readings.mean(0), floor + step / 2, rtol=0, atol=5 * error)
    assert Normal(bits=bits).name == f"normal(1,bits={bits})"


@pytest.mark.parametrize(("bits", "scale"), [(0, 255), (9, 255), (5, 1)])
def test_bits_are_of_bytes(bits, scale):
    with pytest.raises(ForbesError, match=f"bits is {bits} at scale {scale}, expected 1 to 8"):
        Normal(scale=scale, bits=bits)


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


def vectors():
    return torch.randn(6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_vector_normal_is_that_of_torch_distributions():
    expected = distributions.Normal(vectors(), 0.3).log_prob(vectors().flip(0)).sum(-1)

    torch.testing.assert_close(VectorNormal(0.3).log_prob(vectors(), vectors().flip(0)), expected)


def test_symlog_normal_is_a_density_of_the_observation():
    """Over x in [-e^8, e^8], beyond which symlog x is 8 σ away: the sum over a fine grid in the units of x is 1."""
    likelihood, grid = SymlogNormal(), torch.linspace(-8, 8, 16_001).double()
    x = grid.sign() * grid.abs().expm1()  # dense where the density is, (16001,)

    density = likelihood.log_prob(torch.full((1,), -0.7).double(), symlog(x)[:, None]).exp()

    assert abs(torch.trapezoid(density, x) - 1) < 1e-4
    assert likelihood.target(torch.tensor([torch.e - 1, 0.0, 1 - torch.e])).tolist() == pytest.approx([1, 0, -1])


def test_one_hot_is_the_categorical_of_torch_distributions():
    symbol = torch.arange(6) % 5
    target = torch.nn.functional.one_hot(symbol, 5)

    expected = distributions.Categorical(logits=vectors()).log_prob(symbol)

    torch.testing.assert_close(OneHot().log_prob(vectors(), target), expected)
    torch.testing.assert_close(OneHot().mean(vectors()), distributions.Categorical(logits=vectors()).probs)


@pytest.mark.parametrize(
    "likelihood", [Bernoulli(), Normal(0.5), VectorNormal(0.5), OneHot()], ids=lambda density: density.name
)
def test_samples_have_the_mean_and_the_density_of_the_likelihood(likelihood):
    """The expectation of p(x) / p'(x) over samples of p' is one, for another density p of the same family."""
    output, number = vectors()[0].view(1, 1, 5), 40_000
    torch.manual_seed(0)

    sample = likelihood.sample(output.expand(number, 1, 1, 5))  # (N, C, H, W), or (N, 1, 1, O)

    log_ratio = likelihood.log_prob(output + 0.2, sample) - likelihood.log_prob(output, sample)
    ratio = log_ratio.reshape(number, -1).sum(1).exp()
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / number**0.5
    expected = output if isinstance(likelihood, Normal) else likelihood.mean(output)  # without the pictures' shift
    assert ((sample.mean(0) - expected).abs() < 4 * sample.std(0) / number**0.5 + 1e-12).all()
