"""The state-space model: what each step may know, that the fast form is the plain one, and that nothing leaks."""

from functools import partial

import pytest
import torch
from small_models import (
    BATCH,
    HIDDEN,
    PARTS,
    SHAPE,
    STATE,
    STATE_SPACE,
    TIME,
    make_model,
    random_model,
    random_state,
    sequences,
)

from forbes.beliefs import GaussianBelief
from forbes.errors import ForbesError
from forbes.models import Bernoulli, Filtered, MLPDecoder, MLPEncoder, ModelParts, State, StateSpaceModel, elbo_loss
from forbes.models.networks import activate


@pytest.fixture(params=STATE_SPACE, name="family")
def family_fixture(request):
    return request.param


def step_by_step(model, observation, action, kl="monte_carlo"):
    """The bound as the paper writes it: one network call per factor and per step, nothing shared or deferred."""
    hidden, state = model.initial(len(observation))
    reconstruction, divergence = [], []
    for t in range(observation.shape[1]):
        target = model.likelihood.target(observation[:, t]).double()
        hidden = model.gru(model.transition(torch.cat((state, action[:, t]), -1)), hidden)
        context = model.posterior_context(torch.cat((hidden, model.encoder(target)), -1))
        state, log_posterior = model.posterior.rsample(context)
        if kl == "path":
            log_posterior = model.posterior.path_log_prob(state, context)
        divergence.append(log_posterior - model.prior.log_prob(state, model.prior_context(hidden)))
        reconstruction.append(model.likelihood.log_prob(model.decoder(torch.cat((hidden, state), -1)), target))
    return torch.stack(reconstruction, 1), torch.stack(divergence, 1)


@pytest.mark.parametrize("copies", [1, 2])
def test_the_prepared_steps_are_the_plain_steps(family, copies):
    """Values, and gradients of every parameter, of embeddings and of actions."""
    model, (observation, action, _) = random_model(family), sequences()
    embedding = model.embed(observation).detach().requires_grad_()
    action.requires_grad_()
    wanted = {**dict(model.named_parameters()), "embedding": embedding, "action": action}
    prepared = model.prepare_step(embedding, action, copies)
    plain = (
        partial(model.step, embedding=embedding[:, t].repeat(copies, 1), action=action[:, t].repeat(copies, 1))
        for t in range(TIME)
    )

    results = []
    for steps in ([prepared] * TIME, plain):
        torch.manual_seed(0)
        state, filtered = model.initial(copies * BATCH), []
        for step in steps:
            filtered.append(step(state))
            state = State(filtered[-1].hidden, filtered[-1].state)
        values = [torch.stack(parts) for parts in zip(*filtered, strict=True)]  # 4 x (T, N B, ...)
        loss = sum((part.square().sum() for part in values), start=torch.zeros(()))
        gradients = torch.autograd.grad(loss, list(wanted.values()), allow_unused=True)
        results.append(dict(zip([*Filtered._fields, *wanted], [*values, *gradients], strict=True)))

    for name, expected in results[1].items():
        if expected is None:
            assert results[0][name] is None, name
            assert name.startswith(("prior", "encoder", "decoder")), name
        else:
            assert (results[0][name] - expected).abs().max() <= 1e-12 * max(1, expected.abs().max()), name


@pytest.mark.usefixtures("same_noise")
def test_filtering_one_step_is_the_step(family):
    model, (observation, action, _) = random_model(family), sequences()
    embedding, before = model.embed(observation), random_state(model)

    filtered = model.filter(embedding[:, :1], action[:, :1], before)
    step = model.step(before, embedding[:, 0], action[:, 0])

    torch.testing.assert_close(Filtered(*(values[:, 0] for values in filtered)), step, rtol=0, atol=0)


def test_a_step_more_than_was_prepared_is_one_sentence(family):
    model, (observation, action, _) = random_model(family), sequences()
    step, state = model.prepare_step(model.embed(observation), action), model.initial(BATCH)

    for _ in range(TIME):
        step(state)

    with pytest.raises(ForbesError, match=f"TimeLoop: more than {TIME} steps"):
        step(state)


@pytest.mark.usefixtures("same_noise")
@pytest.mark.parametrize(
    ("activation", "kl"),
    [("relu", "monte_carlo"), ("elu", "monte_carlo"), ("norm_silu", "monte_carlo"), ("relu", "path")],
)
def test_the_bound_and_its_gradients_are_those_of_the_plain_loop(family, activation, kl):
    model, (observation, action, mask) = random_model(family), sequences()
    activate(model, activation)
    model.double()
    if not model.posterior.reparameterised:
        kl = "monte_carlo"

    terms = model.lower_bound(observation, action, mask, kl)
    reconstruction, divergence = step_by_step(model, observation, action, kl)
    gradients = torch.autograd.grad(terms.elbo.sum(), list(model.parameters()))
    expected = torch.autograd.grad((reconstruction - divergence).sum(), list(model.parameters()))

    torch.testing.assert_close(terms.kl, divergence)
    # The decoder's output is rounded to float32.
    torch.testing.assert_close(terms.reconstruction, reconstruction, rtol=1e-6, atol=1e-6)
    for (name, _), got, want in zip(model.named_parameters(), gradients, expected, strict=True):
        assert (got - want).abs().max() <= 1e-6 * want.abs().max(), name


@pytest.mark.usefixtures("same_noise")
def test_how_the_kl_is_differentiated_changes_no_value(family):
    model, batch = random_model(family), sequences()

    found = {kl: model.lower_bound(*batch, kl) for kl in ("analytic", "monte_carlo", "path")}

    for kl in ("analytic", "path"):
        torch.testing.assert_close(found[kl].elbo, found["monte_carlo"].elbo)
        torch.testing.assert_close(found[kl].kl, found["monte_carlo"].kl)
    closed = {kl for kl, terms in found.items() if terms.analytic_kl is not None}
    assert closed == ({"analytic"} if family in ("gaussian", "categorical") else set())


@pytest.mark.parametrize(
    ("family", "kl"),
    [
        ("gaussian", "analytic"),
        *((family, "path") for family in ("gaussian", "flow", "mixture", "particles", "soft particles")),
    ],
)
def test_the_gradient_of_the_bound_is_the_same_on_average(family, kl, monkeypatch):
    """Against the plain gradient, with the same noise: what is left out has mean 0."""
    monkeypatch.setitem(PARTS, "soft particles", {})  # a Gaussian belief: the flow has a case of its own
    model, (observation, action, mask), number = random_model(family), sequences(), 30
    parameters = list(model.parameters())

    def gradient(kl, seed):
        torch.manual_seed(seed)
        return torch.cat(
            [g.flatten() for g in torch.autograd.grad(elbo_loss(model.lower_bound(*batch, kl)), parameters)]
        )

    # 128 draws in a batch cost less than 128 batches.
    batch = (observation[:2, :3].repeat(128, 1, 1, 1, 1), action[:2, :3].repeat(128, 1, 1), mask[:2, :3].repeat(128, 1))
    plain, other = (torch.stack([gradient(each, seed) for seed in range(number)]) for each in ("monte_carlo", kl))

    difference = other - plain  # (number, parameters)
    error = difference.std(0) / number**0.5
    moved = error > 1e-9
    # Student's |t| of 29 degrees of freedom exceeds 7 with probability 1e-7, in one of 6,000 parameters with 6e-4.
    assert (difference.mean(0)[moved] / error[moved]).abs().max() < 7
    assert (other.mean(0)[moved] / error[moved]).abs().max() > 14  # a gradient off by a half would be seen
    assert moved.sum() > 50


@pytest.mark.usefixtures("same_noise")
@pytest.mark.parametrize(
    ("kind", "same"),
    [("flow", "path"), ("mixture", "path"), ("particles", "monte_carlo"), ("soft particles", "monte_carlo")],
)
def test_without_a_closed_form_the_default_is_another_estimator(kind, same):
    """With the same noise the gradients are equal, and those of the third option are not."""
    model, batch = random_model(kind), sequences()
    parameters = list(model.posterior.parameters())
    default, path, plain = (
        torch.autograd.grad(elbo_loss(model.lower_bound(*batch, kl)), parameters)
        for kl in ("analytic", "path", "monte_carlo")
    )

    equal, other = (path, plain) if same == "path" else (plain, path)
    torch.testing.assert_close(default, equal)
    assert not any(torch.allclose(got, not_it) for got, not_it in zip(default, other, strict=True))


@pytest.mark.usefixtures("same_noise")
def test_filtering_a_prefix_gives_the_prefix(family):
    model, (observation, action, _) = random_model(family), sequences()
    embedding = model.embed(observation)

    whole = model.filter(embedding, action)
    prefix = model.filter(embedding[:, :3], action[:, :3])

    for part, of_whole in zip(prefix, whole, strict=True):
        torch.testing.assert_close(part, of_whole[:, :3])


def test_filtering_a_prefix_with_the_same_seed_gives_the_prefix(family):
    """The noise of a step does not depend on how many steps follow."""
    model, (observation, action, _) = random_model(family), sequences()
    embedding = model.embed(observation)

    torch.manual_seed(0)
    whole = model.filter(embedding, action)
    torch.manual_seed(0)
    prefix = model.filter(embedding[:, :3], action[:, :3])

    torch.testing.assert_close(prefix.state, whole.state[:, :3])


@pytest.mark.usefixtures("same_noise")
def test_filtering_goes_on_from_where_it_stopped(family):
    model, (observation, action, _) = random_model(family), sequences()
    embedding = model.embed(observation)

    whole = model.filter(embedding, action)
    first = model.filter(embedding[:, :3], action[:, :3])
    second = model.filter(embedding[:, 3:], action[:, 3:], first.at(2))

    torch.testing.assert_close(second.state, whole.state[:, 3:])
    torch.testing.assert_close(second.hidden, whole.hidden[:, 3:])


def test_no_step_sees_later_observations_or_actions(family):
    model, (observation, action, _) = random_model(family), sequences()
    embedding = model.embed(observation).detach().requires_grad_()
    action.requires_grad_()
    filtered, t = model.filter(embedding, action), 2

    for belief, sees_observation in [(filtered.hidden, t - 1), (filtered.state, t), (filtered.log_prob, t)]:
        by_embedding, by_action = torch.autograd.grad(belief[:, t].sum(), (embedding, action), retain_graph=True)
        encoded = by_embedding.ne(0).any(-1).any(0)
        assert encoded.tolist() == [step <= sees_observation for step in range(TIME)]
        assert by_action.ne(0).any(-1).any(0).tolist() == [step <= t for step in range(TIME)]


def test_an_untrained_flow_model_equals_the_gaussian_one():
    gaussian, flow = make_model("gaussian", seed=0), make_model("flow", seed=1)
    missing, unexpected = flow.load_state_dict(gaussian.state_dict(), strict=False)
    flow.prior.base.load_state_dict(gaussian.prior.state_dict())
    flow.posterior.base.load_state_dict(gaussian.posterior.state_dict())
    assert all(name.startswith(("prior.", "posterior.")) for name in (*missing, *unexpected))
    observation, action, mask = sequences()
    results = []

    for model in (gaussian, flow):
        torch.manual_seed(0)
        filtered = model.filter(model.embed(observation), action)
        torch.manual_seed(0)
        terms = model.lower_bound(observation, action, mask)
        rollout = model.imagine(filtered.at(-1), action)
        results.append((*filtered, model.prior_log_prob(filtered), terms.reconstruction, terms.kl, *rollout))

    for expected, got in zip(*results, strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)


def test_a_second_backward_pass_gives_the_same_gradients(family):
    """Also after a pass that wants the gradients of the actions only, and one of the first steps only."""
    model, (observation, action, mask) = random_model(family), sequences()
    action.requires_grad_()
    terms, parameters = model.lower_bound(observation, action, mask), list(model.parameters())
    loss = terms.elbo.sum()

    expected = torch.autograd.grad(loss, parameters, retain_graph=True)
    torch.autograd.grad(loss, action, retain_graph=True)
    torch.autograd.grad(terms.kl[:, :2].sum(), parameters, retain_graph=True, allow_unused=True)
    again = torch.autograd.grad(loss, parameters)

    torch.testing.assert_close(again, expected)


def test_gradients_of_some_steps_are_those_of_the_plain_loop(family, same_noise):
    model, (observation, action, mask) = random_model(family), sequences()

    gradients, expected = (
        torch.autograd.grad(kl[:, 2].sum(), list(model.parameters()), allow_unused=True)
        for kl in (
            model.lower_bound(observation, action, mask, "monte_carlo").kl,
            step_by_step(model, observation, action)[1],
        )
    )

    torch.testing.assert_close(gradients, expected)


def test_a_frozen_model_passes_gradients_to_the_actions(family, same_noise):
    """What an actor learns from: imagination and filter, the world model fixed while the graph is built."""
    model, (observation, action, _) = random_model(family), sequences()
    action.requires_grad_()

    def gradient():
        filtered = model.filter(model.embed(observation), action)
        rollout = model.imagine(filtered.at(-1), action)
        return torch.autograd.grad(rollout.features.sum() + rollout.log_prob.sum(), action)[0]

    expected = gradient()
    model.requires_grad_(False)

    torch.testing.assert_close(gradient(), expected)
    assert expected.ne(0).any(-1).all()


@pytest.mark.usefixtures("same_noise")
def test_imagination_is_the_plain_loop_over_the_prior(family):
    model, (_, action, _) = random_model(family), sequences()
    hidden, state = start = random_state(model)

    rollout = model.imagine(start, action)

    assert rollout.features.shape == (BATCH, TIME, HIDDEN + STATE)
    for t in range(TIME):
        hidden = model.gru(model.transition(torch.cat((state, action[:, t]), -1)), hidden)
        state, log_prob = model.prior.rsample(model.prior_context(hidden))
        torch.testing.assert_close(rollout.features[:, t], torch.cat((hidden, state), -1))
        torch.testing.assert_close(rollout.log_prob[:, t], log_prob)


def bistable_model():
    """A prior that drives s > 0 to 3 and s < 0 to -3: N(3 clip(10 s, -1, 1), 0.5²), the clip made of two ReLUs."""
    scale = 1e-4  # of h, so small that the GRU's tanh is linear
    parts = ModelParts(
        belief=partial(GaussianBelief, min_std=0.5),
        encoder=MLPEncoder(SHAPE, 4, 1),
        decoder=MLPDecoder(4 + 2, SHAPE, 4, 1),
        likelihood=Bernoulli(),
        action_dim=0,
        state_dim=2,
        hidden_dim=4,
        mlp_dim=4,
        mlp_layers=1,
    )
    model = StateSpaceModel(parts)
    eye = torch.eye(2)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
        model.transition[0][0].weight.copy_(10 * torch.cat((eye, eye)))
        model.transition[0][0].bias.copy_(torch.tensor([1.0, 1, -1, -1]))  # relu(10 s + 1), relu(10 s - 1)
        model.gru.weight_ih[8:] = scale * torch.eye(4)  # the new state
        model.gru.bias_ih[4:8] = -100.0  # the update gate: nothing of the old state
        model.prior_context[0][0].weight.copy_(torch.eye(4) / scale)
        model.prior.parameters_of.weight[:2] = torch.cat((3 * eye, -3 * eye), 1)
        model.prior.parameters_of.bias.copy_(torch.tensor([-3.0, -3, -100, -100]))  # softplus(-100) = 0: std is min_std
    return model


def test_in_imagination_one_mode_stays_one_mode():
    model, samples = bistable_model(), 500
    torch.manual_seed(0)

    states = model.imagine(model.initial(samples), torch.zeros(samples, 12, 0)).state[:, 5:]  # (N, T, D)

    sides = states > 0
    assert torch.equal(sides, sides[:, :1].expand_as(sides)), "a trajectory changed its mode"
    assert states.abs().min() > 3 - 5 * 0.5
    share = sides[:, 0].float().mean(0)  # of each dimension in the upper mode
    assert ((share - 0.5).abs() < 4 * 0.5 / samples**0.5).all(), "the modes are not equally likely"
