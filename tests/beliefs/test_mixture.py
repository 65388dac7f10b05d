"""The mixture belief against torch.distributions, and its gradients against the moments they are of."""

import math

import torch
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from forbes.beliefs import MixtureBelief

CONTEXT = 6


def head(dim=3, components=4, seed=0):
    """A mixture of components several standard deviations apart."""
    torch.manual_seed(seed)
    belief = MixtureBelief(dim, CONTEXT, components).double()
    with torch.no_grad():
        belief.parameters_of.weight *= 3
    return belief


def contexts(*shape, seed=1):
    return torch.randn(*shape, CONTEXT, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_density_is_that_of_torch_distributions():
    belief, context = head(), contexts(5)
    state = 3 * torch.randn(8, 5, 3, dtype=torch.float64)
    log_weight, mean, std = belief.mixture(context)

    oracle = MixtureSameFamily(Categorical(logits=log_weight), Independent(Normal(mean, std), 1))

    torch.testing.assert_close(belief.log_prob(state, context), oracle.log_prob(state))


def test_standard_deviation_never_falls_below_its_minimum():
    belief = MixtureBelief(4, CONTEXT, min_std=0.25)

    assert belief.mixture(1e4 * contexts(50).float()).std.min() == 0.25


def test_draws_are_the_quantiles_of_the_noise_given_the_dimensions_before():
    r"""F_d is the CDF of s_d in the mixture that the dimensions before it leave, by torch.distributions."""
    belief, context = head(), contexts(50)
    log_weight, mean, std = belief.mixture(context)

    torch.manual_seed(0)
    state, _ = belief.rsample(context, (20,))  # (20, 50, 3)
    torch.manual_seed(0)
    noise = torch.randn(20, 50, 3, dtype=torch.float64)

    for d in range(3):
        before = Independent(Normal(mean[..., :d], std[..., :d]), 1).log_prob(state[..., None, :d])  # (20, 50, M)
        own = MixtureSameFamily(Categorical(logits=log_weight + before), Normal(mean[..., d], std[..., d]))
        # The error of s is one rounding of its bracket, some tens wide; the density is below 4 = 1 / (0.1 sqrt(2 pi)).
        torch.testing.assert_close(own.cdf(state[..., d]), Normal(0, 1).cdf(noise[..., d]), rtol=0, atol=1e-12)


def test_gradients_of_samples_are_unbiased_for_weights_means_and_standard_deviations():
    r"""The mean of :math:`\partial |s|^2 / \partial c` is :math:`\partial_c \sum_m w_m (|\mu_m|^2 + |\sigma_m|^2)`."""
    belief, number = head(dim=2, seed=1), 20_000
    at = contexts(1)[0].requires_grad_()
    repeated = at.detach().expand(number, -1).clone().requires_grad_()

    log_weight, mean, std = belief.mixture(at)
    expected = torch.autograd.grad((log_weight.exp() * (mean.square() + std.square()).sum(-1)).sum(), at)[0]
    torch.manual_seed(0)
    gradients = torch.autograd.grad(belief.rsample(repeated)[0].square().sum(), repeated)[0]  # (number, C)

    error = gradients.std(0) / math.sqrt(number)
    assert ((gradients.mean(0) - expected).abs() < 4 * error).all()
    assert (error < 0.1 * expected.norm()).all(), "the samples are too few to see a bias"


def test_a_draw_between_modes_that_never_meet_keeps_its_gradients_finite(monkeypatch):
    belief, context = MixtureBelief(1, CONTEXT, components=2), torch.zeros(3, CONTEXT)
    with torch.no_grad():
        belief.parameters_of.bias.copy_(torch.tensor([0.0, 0, -1000, 1000, -3, -3]))
    monkeypatch.setattr(torch, "randn", lambda shape, **options: torch.zeros(shape, **options))  # the median

    state, log_prob = belief.rsample(context)
    gradients = torch.autograd.grad(state.sum() + log_prob.sum(), list(belief.parameters()))

    assert (state.abs() < 1000).all()
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_both_tails_keep_their_precision_in_float32():
    """Four all but equal components are one Gaussian, whose quantiles are its noise."""
    belief, context = MixtureBelief(1, CONTEXT, components=4), torch.zeros(200_000, CONTEXT)
    with torch.no_grad():
        belief.parameters_of.bias.copy_(torch.tensor([0.0] * 4 + [1.0] * 4 + [2.0] * 4))
        belief.parameters_of.bias[4:8] += torch.tensor([-3e-3, -1e-3, 1e-3, 3e-3])  # a bracket to search
    _, mean, std = belief.mixture(context[:1])

    torch.manual_seed(0)
    state = belief.rsample(context)[0].detach()
    torch.manual_seed(0)
    noise = torch.randn(len(context), 1)

    assert noise.abs().max() > 4
    # The components' means differ by 2e-3 standard deviations, of which the mixture's shape shows the square.
    torch.testing.assert_close((state - mean.mean()) / std.mean(), noise, rtol=0, atol=2e-5)
