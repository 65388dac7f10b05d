"""A known process with a learned belief: its density, what it may see, and its bound against exact numbers."""

import math

import pytest
import torch
from torch import nn

from forbes.beliefs import GaussianBelief, MixtureBelief
from forbes.evaluation.theorem import ClosedFormProcess, elbo, exact_filter, log_evidence
from forbes.models.known_model import KnownModel, LearnedBelief, Standardizer
from forbes.pomdps import LinearGaussian, MountainHike, Ungm


def made(process, belief=GaussianBelief, steps=6):
    """A model with random weights in float64, and sequences of its process."""
    torch.manual_seed(0)
    drawn = process.sample(50, steps, torch.Generator().manual_seed(0))
    inputs = torch.cat((drawn.observation, drawn.action), -1)
    model = KnownModel(
        process, belief, Standardizer(drawn.state.flatten(0, 1)), Standardizer(inputs.flatten(0, 1)), 5, 8, 1
    )
    return model.double(), drawn


def test_units_have_mean_zero_and_variance_one_and_their_inverse():
    x = 7 + 30 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    units = Standardizer(x).double()
    z = units(x)

    rounding = {"rtol": 0, "atol": 1e-5}  # the numbers are kept in float32
    torch.testing.assert_close(z.mean(0), torch.zeros(3, dtype=torch.float64), **rounding)
    torch.testing.assert_close(z.var(0), torch.ones(3, dtype=torch.float64), **rounding)
    torch.testing.assert_close(units.inverse(z), x)
    jacobian = torch.autograd.functional.jacobian(units.inverse, z[0])
    torch.testing.assert_close(units.log_det(), torch.linalg.slogdet(jacobian).logabsdet)


@pytest.mark.parametrize("belief", [GaussianBelief, MixtureBelief])
def test_the_belief_is_a_density_over_the_states_of_the_process(belief):
    """Of a random walk whose scale is 100, so that the units matter."""
    model, drawn = made(LinearGaussian(transition_variance=1e4, observation_variance=1e4, initial_variance=1e4), belief)
    learned = model.belief(drawn.observation[:3], drawn.action[:3])
    grid = torch.linspace(-5000, 5000, 20001, dtype=torch.float64)

    density = learned.log_prob(grid.view(-1, 1, 1, 1)).exp()  # (G, 3, T)
    state, log_prob = learned.rsample(7)

    torch.testing.assert_close(torch.trapezoid(density, grid, dim=0), torch.ones(3, 6, dtype=torch.float64))
    torch.testing.assert_close(learned.log_prob(state), log_prob)


def test_samples_depend_on_the_generator_only():
    model, drawn = made(MountainHike())
    learned = model.belief(drawn.observation, drawn.action)
    draws = []
    for disturbance in (1, 2):
        torch.manual_seed(disturbance)
        expected = torch.rand(3)
        torch.manual_seed(disturbance)
        draws.append(learned.sample(4, torch.Generator().manual_seed(0)))
        assert torch.equal(torch.rand(3), expected)  # and nobody else's numbers change

    assert torch.equal(*draws)
    assert draws[0].shape == (4, *drawn.state.shape)
    assert not torch.equal(draws[0], learned.sample(4, torch.Generator().manual_seed(1)))


def test_the_belief_depends_on_the_past_only():
    model, drawn = made(MountainHike())
    observation, action, at = drawn.observation, drawn.action, drawn.state

    whole = model.belief(observation, action).log_prob(at)
    prefix = model.belief(observation[:, :4], action[:, :4]).log_prob(at[:, :4])
    changed = observation.clone().requires_grad_()
    model.belief(changed, action).log_prob(at)[:, 3].sum().backward()

    torch.testing.assert_close(whole[:, :4], prefix)
    assert changed.grad[:, :4].any(-1).all()
    assert not changed.grad[:, 4:].any()


@pytest.mark.parametrize("process", [LinearGaussian(0.9, 0.5, 2.0), Ungm()], ids=["linear-Gaussian", "ungm"])
def test_the_exponential_of_one_path_averages_to_the_evidence(process):
    """E_q[p(s, o) / q(s | o)] = p(o), whatever q is: each density is there once, and at the right step."""
    model, drawn = made(process, steps=2)
    exact = process.log_likelihood(drawn.observation[:1], drawn.action[:1])
    many = 200_000
    observation, action = (values[:1].expand(many, -1, -1) for values in (drawn.observation, drawn.action))

    with torch.no_grad():
        bound = model.elbo(observation, action, torch.ones(many, 2)).elbo
    ratio = (bound - exact).exp()

    error = ratio.std() / math.sqrt(many)
    assert error < 0.02
    assert abs(ratio.mean() - 1) < 4 * error


def test_the_exact_filters_bound_has_the_gap_of_the_theory():
    """log p - ELBO = 5.19 nats at F = Q = R = 1, T = 15, in closed form; the bound's mean, over sequences of p."""
    process, closed = LinearGaussian(), ClosedFormProcess(steps=15)
    _, observation, action = process.sample(4000, 15, torch.Generator().manual_seed(0))
    exact = process.exact_filter(observation, action)
    head = GaussianBelief(1, 2, min_std=0.0)
    head.parameters_of = nn.Identity()  # the context is mean and softplus⁻¹ of the standard deviation
    context = torch.cat((exact.belief.mean, exact.belief.variance.sqrt().expm1().log()), -1)
    units = Standardizer(
        torch.tensor([[-1.0], [1.0]], dtype=torch.float64) / math.sqrt(2)
    )  # mean 0, standard deviation 1
    model, _ = made(process)
    model.belief = lambda *_: LearnedBelief(head, context, units.double())
    torch.manual_seed(0)

    gap = exact.log_likelihood - model.elbo(observation, action, torch.ones(4000, 15)).elbo

    expected = log_evidence(closed, closed.moment()) - elbo(closed, exact_filter(closed), closed.moment())
    assert expected == pytest.approx(5.19, abs=0.005)
    assert abs(gap.mean() - expected) < 4 * gap.std() / math.sqrt(len(gap))
