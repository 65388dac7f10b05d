"""The actor's distribution against torch.distributions."""

import itertools
import math

import pytest
import torch
from torch.distributions import Independent, Normal, OneHotCategorical, TanhTransform, TransformedDistribution

from forbes.control import policy as policies
from forbes.control.policy import Actor, ScalarHead, TanhNormal, TwoHotHead


def policy(*shape, std=1.0):
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(*shape, 2, generator=generator, dtype=torch.float64)
    return TanhNormal(mean, torch.full_like(mean, std))


def oracle(ours):
    return TransformedDistribution(Independent(Normal(ours.mean, ours.std), 1), [TanhTransform()])


def test_log_probability_is_that_of_a_transformed_gaussian():
    ours = policy(5)
    torch.manual_seed(0)
    action, log_prob = ours.rsample((1000,))

    # atanh loses digits near the border: its error is about 1e-16 / (1 - a²), and |d log p / da| is of that size too
    inside = action.abs().amax(-1) < 0.9999
    assert inside.double().mean() > 0.95
    torch.testing.assert_close(log_prob[inside], oracle(ours).log_prob(action)[inside], rtol=1e-7, atol=1e-7)


def test_density_integrates_to_one():
    ours = TanhNormal(torch.tensor([0.3], dtype=torch.float64), torch.tensor([0.5], dtype=torch.float64))
    grid = torch.linspace(-1, 1, 20_003, dtype=torch.float64)[1:-1, None]

    total = oracle(ours).log_prob(grid).exp().mean() * 2

    assert abs(total - 1) < 1e-3  # so the oracle is a density; ours agrees with it above


def test_log_prob_is_finite_where_the_action_rounds_to_one():
    action, log_prob = TanhNormal(torch.full((1,), 40.0), torch.ones(1)).rsample()

    assert action == 1
    assert torch.isfinite(log_prob)


def test_actions_follow_gradients():
    ours = policy(4)
    ours.mean.requires_grad_()
    torch.manual_seed(0)
    action, _ = ours.rsample()

    (gradient,) = torch.autograd.grad(action.sum(), ours.mean)

    torch.testing.assert_close(gradient, 1 - action.detach() ** 2)


def test_the_mode_is_chosen_for_each_row_on_its_own():
    """Narrow policies, whose mode is near tanh of the mean; one row's choice must not decide for another."""
    ours = policy(50, std=0.01)
    torch.manual_seed(0)

    mode = ours.mode()

    # every one of 100 samples is within 5 standard deviations of the mean but with probability 6e-5
    assert (torch.atanh(mode) - ours.mean).abs().max() < 0.05
    best = oracle(ours).log_prob(mode)
    typical = oracle(ours).log_prob(ours.rsample((100,))[0]).mean(0)
    assert (best > typical).all()


def test_the_actor_starts_almost_bang_bang():
    torch.manual_seed(0)
    actor = Actor(6, 2, 32, 2)

    action, _ = actor(torch.randn(1000, 6)).rsample()

    assert (action.abs() > 0.9).float().mean() > 0.6
    assert (action.mean(0).abs() < 0.2).all()


def test_discrete_actions_follow_their_probabilities():
    logits = torch.tensor([[0.0, 1.0, -1.0], [3.0, 0.0, 0.0]], dtype=torch.float64)
    torch.manual_seed(0)
    ours, theirs, draws = (
        policies.OneHotCategorical(logits.expand(20_000, 2, 3)),
        OneHotCategorical(logits=logits),
        20_000,
    )

    action, log_prob = ours.rsample()

    assert torch.equal(action.sum(-1), torch.ones(draws, 2, dtype=torch.float64))
    assert set(action.unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(log_prob, theirs.log_prob(action))
    error = (theirs.probs * (1 - theirs.probs) / draws).sqrt()
    assert ((action.mean(0) - theirs.probs).abs() < 5 * error).all()
    assert ours.mode()[0].tolist() == [[0, 1, 0], [1, 0, 0]]


def test_discrete_surprise_has_the_gradient_of_the_entropy():
    logits = torch.tensor([0.0, 1.0, -1.0], dtype=torch.float64, requires_grad=True)
    torch.manual_seed(0)
    surprise = -policies.OneHotCategorical(logits.expand(40_000, 3)).rsample()[1].mean()

    (gradient,) = torch.autograd.grad(surprise, logits)
    (expected,) = torch.autograd.grad(OneHotCategorical(logits=logits).entropy(), logits)

    assert (gradient - expected).abs().max() < 5 / 40_000**0.5  # a draw's differs by a score, a onehot - p, below 1
    assert expected.abs().min() > 0.05


SIZES = (3, 2, 2)


def several(rows=()):
    """A policy over three choices at a time, by an actor whose head says nothing but its bias, and their logits."""
    actor = Actor(1, sum(SIZES), 4, 1, SIZES).double()
    logits = torch.tensor([0.0, 1.0, -1.0, 0.5, 0.0, -1.0, 1.0], dtype=torch.float64, requires_grad=True)
    torch.nn.init.zeros_(actor.head.weight)
    actor.head.bias.data = logits.data
    return actor(torch.zeros(*rows, 1, dtype=torch.float64)), actor.head.bias


def every_action():
    """All 12 actions, and the log-probability of each of their choices by torch.distributions."""
    _, logits = several()
    eyes = [torch.eye(size, dtype=torch.float64) for size in SIZES]
    chosen = [*itertools.product(*eyes)]
    theirs = [OneHotCategorical(logits=part.detach()) for part in logits.split(SIZES)]
    log_probs = [[p.log_prob(x) for p, x in zip(theirs, choice, strict=True)] for choice in chosen]
    return torch.stack([torch.cat(choice) for choice in chosen]), torch.tensor(log_probs).double(), theirs


def p_value(action):
    """The chi-square test of drawn actions, `(N, A)`, against the joint probabilities of all 12."""
    actions, log_probs, _ = every_action()
    counts = (action[:, None] == actions).all(-1).sum(0)  # (12,)
    assert counts.sum() == len(action)
    expected = len(action) * log_probs.sum(1).exp()
    statistic = ((counts - expected) ** 2 / expected).sum()
    return torch.special.gammaincc(torch.tensor(11 / 2).double(), statistic / 2)


def test_choices_at_a_time_are_drawn_with_their_joint_probability():
    """Of right samplers one in a million is refused, and of those whose last two choices agree too often by 4 %, fewer
    are accepted: the statistic is λ + 11 with standard deviation √(2 (11 + 2 λ)), and the threshold 50.
    """
    torch.manual_seed(0)
    action, log_prob = several((20_000,))[0].rsample()
    every, log_probs, _ = every_action()

    assert p_value(action) > 1e-6
    which = (action[:, None] == every).all(-1).long().argmax(1)  # (N,)
    torch.testing.assert_close(log_prob, log_probs.sum(1)[which])

    joint, agree = log_probs.sum(1).exp(), every[:, 3] == every[:, 5]
    dependent = joint + 0.02 * log_probs[:, 0].exp() * torch.where(agree, 1, -1)  # each choice has its frequency
    noncentrality = (20_000 * (dependent - joint) ** 2 / joint).sum()
    assert noncentrality + 11 - 5 * (2 * (11 + 2 * noncentrality)) ** 0.5 > 50
    assert p_value(every[dependent.multinomial(20_000, replacement=True)]) < 1e-6


def test_the_entropy_of_several_choices_is_the_sum_of_theirs():
    """By enumeration of all actions, and so is its gradient that of the mean of -log p of the draws."""
    _, log_probs, theirs = every_action()
    entropy = -(log_probs.sum(1).exp() * log_probs.sum(1)).sum()
    torch.testing.assert_close(entropy, sum(one.entropy() for one in theirs))

    torch.manual_seed(0)
    ours, logits = several((40_000,))
    surprise = -ours.rsample()[1]
    (gradient,) = torch.autograd.grad(surprise.mean(), logits)

    assert abs(surprise.mean() - entropy) < 5 * surprise.std() / 40_000**0.5
    same = torch.cat([one.logits for one in theirs]).requires_grad_()
    parts = [OneHotCategorical(logits=part) for part in same.split(SIZES)]
    (expected,) = torch.autograd.grad(sum(one.entropy() for one in parts), same)
    assert (gradient - expected).abs().max() < 5 / 40_000**0.5  # a draw's differs by a score, onehot - p, below 1
    assert expected.abs().max() > 0.1


def test_gradients_of_several_choices_are_those_of_their_means():
    """Straight-through: of any linear function of an action it is that of its mean, in each factor."""
    torch.manual_seed(0)
    ours, logits = several()
    weight = torch.randn(7, dtype=torch.float64)

    (gradient,) = torch.autograd.grad((weight * ours.rsample()[0]).sum(), logits)

    mean = torch.cat([part.softmax(-1) for part in logits.split(SIZES)])
    torch.testing.assert_close(gradient, torch.autograd.grad((weight * mean).sum(), logits)[0])


def test_the_mode_of_several_choices_is_the_most_probable_of_all():
    actions, log_probs, _ = every_action()

    assert torch.equal(several()[0].mode(), actions[log_probs.sum(1).argmax()])


def test_one_choice_is_drawn_as_before():
    torch.manual_seed(0)
    actor, features = Actor(6, 4, 8, 1, discrete=True), torch.randn(5, 6)
    one, other = actor(features), policies.OneHotCategorical(actor.head(actor.hidden(features)))

    torch.manual_seed(1)
    first = one.rsample()
    torch.manual_seed(1)
    assert all(map(torch.equal, first, other.rsample()))
    assert type(one) is type(other)


@pytest.mark.parametrize("discrete", [False, True, (1, 1)])
@pytest.mark.parametrize("shape", [(1,), (7,), (3, 4)])
def test_shapes(shape, discrete):
    features = torch.randn(*shape, 6)
    policy = Actor(6, 2, 8, 1, discrete)(features)

    assert [values.shape for values in policy.rsample()] == [(*shape, 2), shape]
    assert policy.mode().shape == (*shape, 2)
    assert TanhNormal(torch.zeros(*shape, 2), torch.ones(*shape, 2)).rsample((5,))[0].shape == (5, *shape, 2)
    for head in (ScalarHead(6, 8, 1), TwoHotHead(6, 8, 1)):
        assert head(features).shape == head.error(features, torch.zeros(shape)).shape == shape


@pytest.mark.parametrize("floor", [1e-4, 0.1])
def test_the_actors_spread_never_falls_below_its_floor(floor):
    actor = Actor(6, 2, 32, 2, min_std=floor)
    torch.nn.init.constant_(actor.head.bias, -1000.0)

    torch.testing.assert_close(actor(torch.zeros(5, 6)).std, torch.full((5, 2), floor))


def test_an_untrained_two_hot_head_says_exactly_zero():
    """Bins reach 5e8; in float32 a plain sum of equal shares of them is off by more than a reward."""
    assert TwoHotHead(6, 8, 1)(torch.randn(100, 6)).abs().max() == 0


def test_the_best_two_hot_head_has_the_mean_of_its_targets():
    """The cross-entropy is least where π is the mean code, whose mean is the mean of the targets."""
    torch.manual_seed(0)
    head, target = TwoHotHead(1, 4, 1, bins=21).double(), torch.tensor([-3.0, 0.5, 40.0, 0.0], dtype=torch.float64)
    same = torch.zeros(4, 1, dtype=torch.float64)
    optimizer = torch.optim.LBFGS(head.parameters(), max_iter=2000, tolerance_grad=1e-9, tolerance_change=1e-14)

    def closure():
        optimizer.zero_grad()
        loss = head.error(same, target).mean()
        loss.backward()
        return loss

    optimizer.step(closure)

    torch.testing.assert_close(head(same), target.mean().expand(4), rtol=1e-3, atol=0)


def test_the_error_of_a_scalar_is_a_gaussians_but_for_a_constant():
    torch.manual_seed(0)
    head, features, target = ScalarHead(6, 8, 1), torch.randn(5, 6), torch.randn(5)

    nats = -Normal(head(features), 1).log_prob(target)

    torch.testing.assert_close(head.error(features, target), nats - 0.5 * math.log(2 * math.pi))
