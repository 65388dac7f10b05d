"""What every belief family promises: its samples have the density it gives. A new family is one line in FAMILIES.

The tests that need a plane to integrate over are for CONTINUOUS families; each has its counterpart for DISCRETE ones,
whose support can be listed.
"""

import math
from functools import cache, partial

import pytest
import torch

from forbes.beliefs import (
    BeliefHead,
    CategoricalBelief,
    FlowBelief,
    GaussianBelief,
    MixtureBelief,
)
from forbes.errors import ForbesError
from forbes.performance.time_loop import TimeLoop

CONTEXT = 3
CLASSES = 3


def one_hots(number, context_dim) -> BeliefHead:
    """As many variables as the others have dimensions."""
    return CategoricalBelief(CLASSES * number, context_dim, classes=CLASSES)


CONTINUOUS = {
    "gaussian": GaussianBelief,
    "flow": partial(FlowBelief, layers=4, width=8),
    "spline": partial(FlowBelief, layers=2, width=8, coupling="spline", bins=5),
    "mixture": partial(MixtureBelief, components=3),
}
SMOOTH = [name for name in CONTINUOUS if name != "mixture"]  # for the same noise, a draw is a smooth map of its context
DISCRETE = {"categorical": one_hots}
FAMILIES = CONTINUOUS | DISCRETE


@pytest.fixture(params=FAMILIES, name="family")
def family_fixture(request):
    return FAMILIES[request.param]


@pytest.fixture(params=CONTINUOUS, name="continuous")
def continuous_fixture(request):
    return CONTINUOUS[request.param]


@pytest.fixture(params=DISCRETE, name="discrete")
def discrete_fixture(request):
    return DISCRETE[request.param]


def random_head(family, dim=2, seed=0) -> BeliefHead:
    """A head in float64 with no weight where it starts."""
    torch.manual_seed(seed)
    head = family(dim, CONTEXT).double()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter += 0.07 * torch.randn_like(parameter)
    return head


def contexts(number, seed=1):
    return torch.randn(number, CONTEXT, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def probability_on_grid(head, context, half_width=20.0, cells=500):
    """Right edges of the cells of a square, (G,), and the probability of each cell by the midpoint rule, (G, G)."""
    edges = torch.linspace(-half_width, half_width, cells + 1, dtype=torch.float64)
    centres, side = (edges[:-1] + edges[1:]) / 2, edges[1] - edges[0]
    with torch.no_grad():
        density = head.log_prob(torch.cartesian_prod(centres, centres), context).exp()  # (G G,)
    return edges[1:], (density * side**2).view(cells, cells)


@cache
def seeded_grid(family, seed):
    """`probability_on_grid` for the head and the context of a seed."""
    return probability_on_grid(random_head(family, seed=seed), contexts(1, seed)[0])


def support(head):
    """Every state that a discrete head can give, (P, D): each variable takes each of its classes."""
    one_hot, number = torch.eye(CLASSES, dtype=torch.float64), head.state_dim // CLASSES
    return one_hot[torch.cartesian_prod(*[torch.arange(CLASSES)] * number)].flatten(1)


def test_the_path_log_density_is_a_function_of_the_state_alone(continuous):
    head, context = random_head(continuous), contexts(5).requires_grad_()
    state = head.rsample(context)[0].detach().requires_grad_()

    path, plain = head.path_log_prob(state, context), head.log_prob(state, context)

    torch.testing.assert_close(path, plain, rtol=0, atol=0)
    (by_state,) = torch.autograd.grad(plain.sum(), state, retain_graph=True)
    torch.testing.assert_close(torch.autograd.grad(path.sum(), state, retain_graph=True)[0], by_state)
    others = [context, *head.parameters()]
    assert not any(part is not None for part in torch.autograd.grad(path.sum(), others, allow_unused=True))
    assert all(parameter.requires_grad for parameter in head.parameters())


def test_the_path_gradient_of_a_zero_kl_has_no_variance(continuous):
    head, context = random_head(continuous), contexts(200)
    prior = random_head(continuous)  # the same parameters, of its own
    state, _ = head.rsample(context)

    kl = head.path_log_prob(state, context) - prior.log_prob(state, context)
    gradients = torch.autograd.grad(kl.sum(), list(head.parameters()), retain_graph=True)
    state, log_posterior = head.rsample(context)
    plain = log_posterior - prior.log_prob(state, context)
    noisy = torch.autograd.grad(plain.sum(), list(head.parameters()))

    largest = max(gradient.abs().max() for gradient in noisy)
    assert largest > 1  # the sum of 200 terms of mean 0 and a variance of about 1
    assert all(gradient.abs().max() < 1e-6 * largest for gradient in gradients)


def test_the_path_gradient_of_a_kl_is_unbiased(continuous):
    """Against the plain gradient at the same draws: what is left out has mean 0."""
    head, prior, number = random_head(continuous), random_head(continuous, seed=1), 4000
    context, groups = contexts(1).expand(number, -1), 100
    state, log_posterior = head.rsample(context)
    left_out = log_posterior - head.path_log_prob(state, context)  # its gradient only

    parameters = list(head.parameters())
    each = [
        torch.cat([g.flatten() for g in torch.autograd.grad(part.mean(), parameters, retain_graph=True)])
        for part in left_out.chunk(groups)
    ]
    gradient = torch.stack(each)  # (groups, parameters)
    kl = (log_posterior - prior.log_prob(state, context)).mean()
    whole = torch.cat([g.flatten() for g in torch.autograd.grad(kl, parameters)])

    error = gradient.std(0) / groups**0.5
    moved = error > 1e-12
    # |t| of 99 degrees of freedom exceeds 6 with probability 3e-8, of some hundred parameters with 1e-5.
    assert (gradient.mean(0)[moved] / error[moved]).abs().max() < 6
    assert (whole[moved] / error[moved]).abs().max() > 6  # where there is a gradient to find, it would be seen


@pytest.mark.parametrize("seed", range(2))
def test_density_integrates_to_one(continuous, seed):
    _, probability = seeded_grid(continuous, seed)

    # The midpoint rule is exact to 1e-6 for densities this smooth; the rest are tails beyond the square.
    assert probability.sum().item() == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("seed", range(2))
def test_probabilities_sum_to_one(discrete, seed):
    head = random_head(discrete, seed=seed)

    probability = head.log_prob(support(head), contexts(1, seed)[0]).exp()

    torch.testing.assert_close(probability.sum(), torch.ones_like(probability[0]))


@pytest.mark.parametrize("seed", range(2))
def test_samples_follow_the_density(continuous, seed):
    edges, probability = seeded_grid(continuous, seed)
    head, context, number = random_head(continuous, seed=seed), contexts(1, seed)[0], 20_000

    samples = head.rsample(context, (number,))[0].detach()  # (number, 2)

    # Kolmogorov-Smirnov in each marginal: the distance exceeds sqrt(-log(a / 2) / 2 n) with probability a = 1e-4.
    limit = math.sqrt(-math.log(1e-4 / 2) / (2 * number))
    for axis in (0, 1):
        expected = probability.sum(1 - axis).cumsum(0)
        observed = torch.searchsorted(samples[:, axis].sort().values, edges, right=True) / number
        assert (observed - expected).abs().max() < limit
    # And both at once: the quadrant below the medians, a share with a standard error of at most sqrt(1 / 4 n).
    row, column = (int(probability.sum(1 - axis).cumsum(0).sub(0.5).abs().argmin()) for axis in (0, 1))
    observed = (samples < torch.stack((edges[row], edges[column]))).all(-1).double().mean()
    assert abs(observed - probability[: row + 1, : column + 1].sum()) < 4 * math.sqrt(0.25 / number)


@pytest.mark.parametrize("seed", range(2))
def test_samples_follow_the_probabilities(discrete, seed):
    head, context, number = random_head(discrete, seed=seed), contexts(1, seed)[0], 20_000
    states = support(head)

    samples = head.rsample(context, (number,))[0].detach()  # (number, D)
    hits = (samples[:, None] - states).abs().amax(-1) < 1e-12  # (number, P); straight-through adds p - p

    assert (hits.sum(1) == 1).all()
    # Hoeffding: one share of the P is further off than sqrt(log(2 P / a) / 2 n) with probability at most a = 1e-4.
    limit = math.sqrt(math.log(2 * len(states) / 1e-4) / (2 * number))
    assert (hits.double().mean(0) - head.log_prob(states, context).exp()).abs().max() < limit


def test_log_prob_of_a_sample_is_what_rsample_gave(family):
    head, context = random_head(family, dim=5), contexts(7)

    state, log_prob = head.rsample(context, (11,))

    assert state.shape == (11, 7, head.state_dim)
    assert log_prob.shape == (11, 7)
    torch.testing.assert_close(head.log_prob(state, context), log_prob)


@pytest.mark.parametrize("name", SMOOTH)
def test_samples_are_reparameterised(name):
    """d/dc E[s] by the gradient of samples equals the difference of means with common noise."""
    head, context = random_head(CONTINUOUS[name]), contexts(1)[0].requires_grad_()

    def mean(at):
        torch.manual_seed(0)
        return head.rsample(at, (100,))[0].sum(-1).mean()

    assert torch.autograd.gradcheck(mean, context)


def test_gradients_of_samples_are_unbiased(continuous):
    """Their mean is d/dc E[exp(-|s|² / 8)], by the midpoint rule on a grid."""
    head, number = random_head(continuous), 20_000
    context = contexts(1)[0].requires_grad_()
    repeated = context.detach().expand(number, -1).clone().requires_grad_()  # (number, C)

    def value(state):
        return (-state.square().sum(-1) / 8).exp()

    centres = torch.linspace(-19.95, 19.95, 400, dtype=torch.float64)
    grid = torch.cartesian_prod(centres, centres)
    mean = (value(grid) * head.log_prob(grid, context).exp()).sum() * 0.1**2
    expected = torch.autograd.grad(mean, context)[0]  # (C,)
    gradients = torch.autograd.grad(value(head.rsample(repeated)[0]).sum(), repeated)[0]  # (number, C)

    error = gradients.std(0) / math.sqrt(number)
    assert ((gradients.mean(0) - expected).abs() < 4 * error).all()
    assert (error < 0.05 * expected.norm()).all(), "the samples are too few to see a bias"


def test_gradients_of_samples_are_those_of_their_mean(discrete):
    """A straight-through sample carries d/dc E[s] itself, and so does whatever is linear in each variable."""
    head, context = random_head(discrete), contexts(1)[0].requires_grad_()
    states, weight = support(head), torch.arange(head.state_dim, dtype=torch.float64)

    sample = (head.rsample(context, (10,))[0] @ weight).mean()
    mean = head.log_prob(states, context).exp() @ states @ weight

    torch.testing.assert_close(torch.autograd.grad(sample, context), torch.autograd.grad(mean, context))


def test_samples_and_densities_train_every_parameter(family):
    head, context = random_head(family, dim=4), contexts(5)
    names = [name for name, _ in head.named_parameters()]

    state, log_prob = head.rsample(context)
    for output in (log_prob.sum() + state.square().sum(), head.log_prob(state.detach(), context).sum()):
        gradients = torch.autograd.grad(output, list(head.parameters()), allow_unused=True)
        idle = [name for name, grad in zip(names, gradients, strict=True) if grad is None or not grad.any()]
        assert idle == []


def test_each_row_is_drawn_from_its_own_context(family):
    head, context = random_head(family), contexts(2)

    state, _ = head.rsample(context, (2000,))
    own, other = head.log_prob(state, context).mean(0), head.log_prob(state, context.flip(0)).mean(0)

    assert (own > other).all()  # Gibbs' inequality


def test_stays_finite_far_from_the_data(family):
    head, context = random_head(family, dim=4).float(), 1e3 * contexts(5).float()

    state, log_prob = head.rsample(context)

    assert state.isfinite().all()
    assert log_prob.isfinite().all()
    assert head.log_prob(1e3 * torch.ones(5, head.state_dim), context).isfinite().all()


def test_a_time_loop_gives_the_same_draws_and_gradients(family):
    head, context = random_head(family, dim=4), contexts(3 * 5).view(3, 5, CONTEXT)
    results = []

    for sample in (head.rsample, head.sampler(TimeLoop(steps=3, batch=5))):
        torch.manual_seed(0)
        states, log_probs = zip(*(sample(step) for step in context), strict=True)
        loss = torch.stack(states).square().sum() + torch.stack(log_probs).sum()
        results.append((loss, *torch.autograd.grad(loss, list(head.parameters()))))

    torch.testing.assert_close(results[0], results[1])


def test_a_time_loop_compiles_to_one_graph(family):
    head, context = random_head(family).float(), contexts(2 * 3).view(2, 3, CONTEXT).float()

    def loss():
        sample = head.sampler(TimeLoop(steps=2, batch=3))
        states, log_probs = zip(*(sample(step) for step in context), strict=True)
        return (torch.stack(log_probs) - head.log_prob(torch.stack(states) + 1, context)).square().sum()

    torch.compiler.reset()
    results = []
    for form in (loss, torch.compile(loss, fullgraph=True, backend="eager")):
        torch.manual_seed(0)
        results.append(torch.autograd.grad(form(), list(head.parameters())))

    torch.testing.assert_close(results[0], results[1])


@pytest.mark.parametrize(
    ("family", "options", "message"),
    [
        (GaussianBelief, {"min_std": -5.0}, "min_std is -5.0, expected at least 0"),
        (MixtureBelief, {"min_std": -5.0}, "min_std is -5.0, expected at least 0"),
        (FlowBelief, {"min_std": -5.0}, "min_std is -5.0, expected at least 0"),
        (MixtureBelief, {"components": 0}, "components is 0, expected at least 1"),
        (FlowBelief, {"coupling": "realnvp"}, "coupling is 'realnvp', expected affine or spline"),
    ],
)
def test_a_number_or_word_without_a_meaning_is_refused(family, options, message):
    with pytest.raises(ForbesError, match=message):
        family(2, CONTEXT, **options)
