"""The mixture belief against torch.distributions, and its gradients against the moments they are of."""

import math

import torch
from scipy.stats import kstest
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from forbes.beliefs import MixtureBelief
from forbes.beliefs.mixture import _reparameterised

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


def test_draws_are_those_of_the_mixture():
    r"""F_d(s_d | s_<d), the CDF of s_d in the mixture that the dimensions before it leave, is uniform for every d."""
    belief, context = head(), contexts(50)
    log_weight, mean, std = belief.mixture(context)

    torch.manual_seed(0)
    state, _ = belief.rsample(context, (400,))  # (400, 50, 3)

    for d in range(3):
        before = Independent(Normal(mean[..., :d], std[..., :d]), 1).log_prob(state[..., None, :d])  # (400, 50, M)
        own = MixtureSameFamily(Categorical(logits=log_weight + before), Normal(mean[..., d], std[..., d]))
        assert kstest(own.cdf(state[..., d]).detach().numpy().ravel(), "uniform").pvalue > 0.001


def test_gradients_are_unbiased_for_weights_means_and_stds():
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


def every_parameter_given(dim, components):
    """A head whose context is its parameters: logits, means, raw standard deviations."""
    size = components * (1 + 2 * dim)
    belief = MixtureBelief(dim, size, components)
    with torch.no_grad():
        belief.parameters_of.weight.copy_(torch.eye(size))
        belief.parameters_of.bias.zero_()
    return belief


def test_a_draw_between_distant_modes_has_finite_gradients():
    belief = every_parameter_given(dim=1, components=2)
    modes = belief.mixture(torch.tensor([0.0, 0, -1000, 1000, -3, -3], requires_grad=True))

    state = _reparameterised(modes, torch.zeros(3, 1))
    gradients = torch.autograd.grad(state.sum() + modes.log_prob(state).sum(), list(modes))

    assert all(gradient.isfinite().all() for gradient in gradients)


def test_in_both_tails_gradients_keep_their_precision_in_float32():
    r"""In one dimension :math:`\partial s / \partial \mathrm{logit}_m = -w_m (\Phi_m(s) - F(s)) / p(s)`."""
    belief = every_parameter_given(dim=1, components=2)
    context = torch.tensor([0.5, -0.5, -0.2, 0.2, 0.5, 1.0]).expand(200_000, -1).clone().requires_grad_()
    torch.manual_seed(0)
    state, _ = belief.rsample(context)
    actual = torch.autograd.grad(state.sum(), context)[0][:, 0].double()  # (200000,)

    log_weight, mean, std = (value.detach().double() for value in belief.mixture(context))
    weight, noise = log_weight.exp(), (state.detach() - mean[..., 0]) / std[..., 0]  # (200000, 2)
    upper = state.detach() > 0
    tail = torch.erfc(torch.where(upper, noise, -noise) / math.sqrt(2)) / 2  # (200000, 2)
    difference = torch.where(upper, -1, 1) * (tail[:, :1] - (weight * tail).sum(-1, keepdim=True))  # (200000, 1)
    density = (weight * Normal(0, 1).log_prob(noise).exp() / std[..., 0]).sum(-1)  # (200000,)

    assert noise.abs().max() > 4
    torch.testing.assert_close(actual, -weight[:, 0] * difference[:, 0] / density, rtol=1e-4, atol=1e-6)
