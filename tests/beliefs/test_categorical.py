"""The categorical belief against torch.distributions."""

import math
import re

import pytest
import torch
from torch.distributions import Independent, OneHotCategorical, kl_divergence

from forbes.beliefs import CategoricalBelief, GaussianBelief
from forbes.errors import ForbesError

CONTEXT = 6


def head(classes=4, seed=0):
    torch.manual_seed(seed)
    return CategoricalBelief(12, CONTEXT, classes).double()


def contexts(*shape, seed=1):
    return 3 * torch.randn(*shape, CONTEXT, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def oracle(belief, context):
    return Independent(OneHotCategorical(logits=belief.logits_of(context).unflatten(-1, (-1, belief.classes))), 1)


def test_probability_is_that_of_torch_distributions():
    belief, context = head(), contexts(5)
    state = oracle(belief, context).sample((8,))  # (8, 5, 3, 4)

    expected = oracle(belief, context).log_prob(state)

    torch.testing.assert_close(belief.log_prob(state.flatten(-2), context), expected)


def test_each_variable_takes_one_class():
    state, _ = head().rsample(contexts(5), (100,))

    variables = state.detach().unflatten(-1, (3, 4))
    torch.testing.assert_close(variables.sort(-1).values, torch.eye(4)[3].double().expand_as(variables))


def test_closed_form_kl_is_that_of_torch_distributions():
    posterior, prior = head(seed=0), head(seed=1)
    context, prior_context = contexts(5, 3, seed=1), contexts(5, 3, seed=2)

    kl = posterior.kl(context, prior, prior_context)

    torch.testing.assert_close(kl, kl_divergence(oracle(posterior, context), oracle(prior, prior_context)))


def test_monte_carlo_kl_has_the_mean_gradient_of_the_closed_form():
    """log q - log p is linear in each variable, so straight-through is exact but for the score, whose mean is zero."""
    posterior, prior, number = head(seed=0), head(seed=1), 20_000
    at = contexts(seed=1).requires_grad_()
    repeated = at.detach().expand(number, -1).clone().requires_grad_()

    expected = torch.autograd.grad(posterior.kl(at, prior, at), at)[0]
    torch.manual_seed(0)
    state, log_prob = posterior.rsample(repeated)
    estimate = log_prob - prior.log_prob(state, repeated)
    gradients = torch.autograd.grad(estimate.sum(), repeated)[0]  # (number, C)

    assert ((gradients.mean(0) - expected).abs() < 4 * gradients.std(0) / number**0.5).all()


@pytest.mark.parametrize("balance", [0.0, 0.5, 0.8, 1.0, (1.0, 0.1), (0.5, 0.0)])
def test_balanced_kl_has_the_gradient_of_the_two_stopped_kls(balance):
    """The definitions of DreamerV2 and DreamerV3, spelled out with torch.distributions."""
    of_prior, of_posterior = balance if isinstance(balance, tuple) else (balance, 1 - balance)
    plain, prior = head(seed=0), head(seed=1)
    balanced = CategoricalBelief(12, CONTEXT, 4, kl_balance=balance).double()
    balanced.load_state_dict(plain.state_dict())
    context, prior_context = (contexts(5, seed=seed).requires_grad_() for seed in (1, 2))
    wanted = [context, prior_context, balanced.logits_of.weight, prior.logits_of.weight]

    def stopped(belief, at):
        return Independent(OneHotCategorical(logits=oracle(belief, at).base_dist.logits.detach()), 1)

    expected = of_prior * kl_divergence(
        stopped(balanced, context), oracle(prior, prior_context)
    ) + of_posterior * kl_divergence(oracle(balanced, context), stopped(prior, prior_context))
    kl = balanced.kl(context, prior, prior_context)

    torch.testing.assert_close(kl, plain.kl(context, prior, prior_context))
    for ours, theirs in zip(
        torch.autograd.grad(kl.sum(), wanted),
        torch.autograd.grad(expected.sum(), wanted, allow_unused=True),
        strict=True,
    ):
        torch.testing.assert_close(ours, torch.zeros_like(ours) if theirs is None else theirs)


@pytest.mark.parametrize("balance", [-0.1, 1.1, float("nan"), (1.0, -0.1)])
def test_refuses_a_balance_outside_0_to_1(balance):
    with pytest.raises(ForbesError, match=re.escape(f"kl_balance is {balance}, expected 0 to 1")):
        CategoricalBelief(12, CONTEXT, 4, kl_balance=balance)


def test_both_weights_may_be_a_list_as_in_a_configuration():
    assert CategoricalBelief(12, CONTEXT, 4, kl_balance=[1, 0.1]).kl_weights == (1, 0.1)


@pytest.mark.parametrize("mix", [0.01, 0.5])
def test_a_uniform_mix_is_that_of_the_probabilities(mix):
    belief, context = CategoricalBelief(12, CONTEXT, 4, uniform_mix=mix).double(), contexts(5)

    mixed = (1 - mix) * belief.logits_of(context).unflatten(-1, (3, 4)).softmax(-1) + mix / 4

    torch.testing.assert_close(belief.log_probabilities(context).exp(), mixed)


def test_a_uniform_mix_bounds_the_kl():
    """A certain posterior meets a prior that is certain of another class: about log(K / m) nats per variable."""
    posterior, prior = (CategoricalBelief(12, CONTEXT, 4, uniform_mix=0.01).double() for _ in range(2))
    for belief, favourite in ((posterior, 0), (prior, 1)):
        torch.nn.init.zeros_(belief.logits_of.weight)
        certain = torch.full((3, 4), -1e4).index_fill(1, torch.tensor(favourite), 1e4).flatten()
        belief.logits_of.bias.data = certain.double()

    kl = posterior.kl(contexts(5), prior, contexts(5))

    assert (kl < 3 * math.log(4 / 0.01)).all()
    assert (kl > 3 * 0.98 * math.log(4 / 0.01)).all()


@pytest.mark.parametrize("mix", [-0.1, 1.0, float("nan")])
def test_refuses_a_mix_that_leaves_nothing(mix):
    with pytest.raises(ForbesError, match=f"uniform_mix is {mix}, expected 0 to below 1"):
        CategoricalBelief(12, CONTEXT, 4, uniform_mix=mix)


def test_other_families_or_classes_have_no_closed_form():
    context = contexts(2)

    assert head().kl(context, GaussianBelief(12, CONTEXT).double(), context) is None
    assert head(classes=4).kl(context, head(classes=6), context) is None


def test_refuses_a_state_that_is_not_made_of_whole_variables():
    with pytest.raises(ForbesError, match="classes is 0, expected at least 1"):
        CategoricalBelief(12, CONTEXT, 0)
    with pytest.raises(ForbesError, match="state_dim is 30, expected a multiple of classes, 32"):
        CategoricalBelief(30, CONTEXT)
