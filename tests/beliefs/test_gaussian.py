"""The Gaussian belief against torch.distributions."""

import math

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from forbes.beliefs import FlowBelief, GaussianBelief

CONTEXT = 6


def head(dim=4, seed=0):
    torch.manual_seed(seed)
    return GaussianBelief(dim, CONTEXT).double()


def contexts(*shape, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, CONTEXT, generator=generator, dtype=torch.float64)


def oracle(belief, context):
    return Independent(Normal(*belief.moments(context)), 1)


def test_density_is_that_of_torch_distributions():
    belief, context = head(), contexts(3)
    state = torch.randn(8, 3, 4, dtype=torch.float64)

    torch.testing.assert_close(belief.log_prob(state, context), oracle(belief, context).log_prob(state))


def test_standard_deviation_never_falls_below_its_minimum():
    belief = GaussianBelief(4, CONTEXT, min_std=0.25)

    _, std = belief.moments(-1e4 * torch.ones(1, CONTEXT) * belief.parameters_of.weight[4:].sum(0).sign())

    assert std.min() == 0.25


def test_closed_form_kl_is_that_of_torch_distributions():
    posterior, prior = head(seed=0), head(seed=1)
    context, prior_context = contexts(5, 3, seed=1), contexts(5, 3, seed=2)

    kl = posterior.kl(context, prior, prior_context)

    torch.testing.assert_close(kl, kl_divergence(oracle(posterior, context), oracle(prior, prior_context)))


def test_monte_carlo_kl_agrees_with_the_closed_form():
    posterior, prior, number = head(seed=0), head(seed=1), 200_000
    context, prior_context = contexts(6, seed=1), contexts(6, seed=2)
    torch.manual_seed(0)

    state, log_prob = posterior.rsample(context, (number,))
    estimates = (log_prob - prior.log_prob(state, prior_context)).detach()  # (number, 6)

    error = (estimates.mean(0) - posterior.kl(context, prior, prior_context)).abs()
    assert (error < 4 * estimates.std(0) / math.sqrt(number)).all()


@pytest.mark.parametrize("belief", [GaussianBelief, FlowBelief])
def test_there_is_no_closed_form_where_one_of_the_two_is_a_flow(belief):
    context = contexts(2)

    assert FlowBelief(4, CONTEXT).double().kl(context, belief(4, CONTEXT).double(), context) is None
    assert GaussianBelief(4, CONTEXT).double().kl(context, FlowBelief(4, CONTEXT).double(), context) is None
