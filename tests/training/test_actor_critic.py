"""The actor-critic: whose gradient goes where, when it is Dreamer, and that it learns to act."""

import itertools
from functools import partial

import pytest
import torch
from batches import batch_of

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.control.actor_critic import sample_starts
from forbes.control.policy import TwoHotHead
from forbes.errors import ForbesError
from forbes.models import MLPDecoder, MLPEncoder, State, VectorNormal
from forbes.training import ImaginationActorCritic, WorldModel

BATCH, TIME = 4, 5
SMALL = {
    "belief": GaussianBelief,
    "encoder": partial(MLPEncoder, width=8, layers=1),
    "decoder": partial(MLPDecoder, width=8, layers=1),
    "likelihood": VectorNormal(),
    "observation_shape": (1,),
    "action_dim": 1,
    "state_dim": 2,
    "hidden_dim": 6,
    "mlp_dim": 8,
    "mlp_layers": 1,
    "free_nats": 0.0,
}


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Without a trainer there is nowhere to log to."""
    for name in ("log", "log_dict"):
        monkeypatch.setattr(ImaginationActorCritic, name, lambda *args, **kwargs: None)


def agent(seed=0, **options):
    torch.manual_seed(seed)
    return ImaginationActorCritic(**{**SMALL, "horizon": 4, "control_dim": 8, **options})


def make_batch(batch=BATCH, time=TIME, seed=0):
    """What an action leads to shows it, o_t = a_{t-1}, and it pays to change: r_t = -o_t o_{t-1}."""
    generator = torch.Generator().manual_seed(seed)
    action = 2 * torch.rand(batch, time, 1, generator=generator) - 1
    action[:, 0] = 0
    reward = -action[..., 0] * action[..., 0].roll(1, 1)
    reward[:, 0] = 0
    return batch_of(action.clone(), action, reward)


def loss_of(module, batch):
    torch.manual_seed(1)
    return module.training_step(batch, 0)


def gradients(loss, modules):
    parameters = [parameter for module in modules for parameter in module.parameters()]
    return torch.autograd.grad(loss, parameters, allow_unused=True, retain_graph=True)


@pytest.mark.parametrize("reward_std", [1.0, 0.1])
def test_the_world_model_learns_from_its_own_loss_only(reward_std):
    ours, batch = agent(reward_std=reward_std), make_batch()
    torch.manual_seed(1)
    seen = ours.model.encode(batch.observation, batch.action)
    filtered = ours.model.filter(seen.embedding, seen.action)
    terms = ours.model.bound(filtered, seen, batch.mask)
    reward = torch.distributions.Normal(ours.reward(filtered.features), reward_std).log_prob(batch.reward)

    torch.manual_seed(1)
    torch.testing.assert_close(ours.log_probs(filtered, batch)["reward"], reward)
    own = gradients(ours.loss(terms) - reward.mean(), [ours.model, ours.reward])
    together = gradients(loss_of(ours, batch), [ours.model, ours.reward])

    for a, b in zip(own, together, strict=True):
        torch.testing.assert_close(a, b)
        assert a.abs().max() > 0


def test_actor_and_critic_learn_each_from_its_own_loss():
    ours, batch = agent(), make_batch()
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    actor, critic = ours.control_losses(filtered, batch.mask)
    others = {"actor": [ours.model, ours.reward, ours.critic], "critic": [ours.model, ours.reward, ours.actor]}

    for name, loss in [("actor", actor), ("critic", critic)]:
        assert all(gradient is None for gradient in gradients(loss, others[name]))
        assert all(gradient.abs().max() > 0 for gradient in gradients(loss, [getattr(ours, name)]))


def test_the_activation_is_that_of_every_perceptron():
    ours = agent(activation="elu")

    assert not [name for name, part in ours.named_modules() if isinstance(part, torch.nn.ReLU)]
    assert len([part for part in ours.modules() if isinstance(part, torch.nn.ELU)]) == 11


def test_nothing_stays_frozen():
    ours = agent()
    loss_of(ours, make_batch())

    assert all(parameter.requires_grad for parameter in ours.parameters())


@pytest.mark.parametrize("continuation", [False, True])
def test_every_parameter_is_in_one_group(continuation):
    ours = agent(continuation=continuation)
    grouped = [parameter for group in ours.groups() for parameter in group.parameters]

    assert len(grouped) == len({id(parameter) for parameter in grouped})
    assert {id(parameter) for parameter in grouped} == {id(parameter) for parameter in ours.parameters()}


def test_each_group_is_clipped_alone():
    """A gradient far above the norm shrinks to it; those of the other groups stay what they are."""
    module = agent(clip_norm=1.0)
    for scale, group in zip((1e3, 1e-3, 1e-4), module.groups(), strict=True):
        for parameter in group.parameters:
            parameter.grad = scale * torch.ones_like(parameter)
    before = [norm_of(group) for group in module.groups()]

    module.configure_gradient_clipping(torch.optim.Adam(module.parameters()))

    after = [norm_of(group) for group in module.groups()]
    assert before[0] > 1 > max(before[1:])
    assert after == [pytest.approx(1, rel=1e-4), *before[1:]]


def norm_of(group):
    return torch.stack([parameter.grad.square().sum() for parameter in group.parameters]).sum().sqrt().item()


@pytest.mark.parametrize("trajectories", [1, 3])
def test_a_flow_that_is_the_identity_is_dreamer(trajectories):
    dreamer = agent(kl="monte_carlo", trajectories=trajectories)
    forbes = agent(kl="monte_carlo", trajectories=trajectories, belief=partial(FlowBelief, layers=2, width=4))

    torch.testing.assert_close(loss_of(forbes, make_batch()), loss_of(dreamer, make_batch()), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("belief", [GaussianBelief, partial(FlowBelief, layers=2, width=4)])
def test_the_first_sample_is_the_filtered_path_and_all_differ(belief):
    model, batch = agent(belief=belief).model, make_batch()
    filtered = model.filter(model.embed(batch.observation), batch.action)

    one, four = sample_starts(model, filtered, 1), sample_starts(model, filtered, 4)

    torch.testing.assert_close(one, State(filtered.hidden[None], filtered.state[None]))
    torch.testing.assert_close(four.state[0], filtered.state)
    for one_of, other in itertools.combinations(four.state, 2):
        assert (one_of - other).abs().amin() > 0
    torch.testing.assert_close(four.hidden, filtered.hidden.expand(4, -1, -1, -1))
    assert not four.state.requires_grad


@pytest.mark.parametrize("entropy", [0.0, 0.3])
@pytest.mark.parametrize("trajectories", [1, 3])
def test_imagined_rewards_and_values_match_their_states(entropy, trajectories):
    """The losses, spelled out along each trajectory, which has a beginning and actions of its own.

    The actor learns what each action leads to, not to reach states in which it would choose another: it sees constants.
    """
    ours, batch = agent(trajectories=trajectories, actor_entropy=entropy), make_batch(1, 2)
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    torch.manual_seed(3)
    actor, critic = ours.control_losses(filtered, batch.mask)

    torch.manual_seed(3)
    state = State(*(values.flatten(0, 2) for values in sample_starts(ours.model, filtered, trajectories)))
    nats, states = [], []
    for _ in range(4):
        action, log_prob = ours.actor(torch.cat(state, -1).detach()).rsample()
        assert action.unique().numel() == 2 * trajectories
        nats.append(-entropy * log_prob)
        rollout = ours.model.imagine(state, action[:, None])
        state = State(rollout.hidden[:, 0], rollout.state[:, 0])
        states.append(torch.cat(state, -1))
    r, v = [ours.reward(f) for f in states], [ours.critic(f) for f in states]
    g, l = 0.99, 0.95  # noqa: E741
    third = r[2] + g * v[3]
    second = r[1] + g * ((1 - l) * v[2] + l * third)
    first = r[0] + g * ((1 - l) * v[1] + l * second)

    acting = (first + nats[0]) + g * (second + nats[1]) + g**2 * (third + nats[2])
    torch.testing.assert_close(actor, -acting.mean() / 3)
    torch.testing.assert_close(gradients(actor, [ours.actor]), gradients(-acting.mean() / 3, [ours.actor]))
    errors = [(value - target) ** 2 / 2 for value, target in zip(v, (first, second, third), strict=False)]
    torch.testing.assert_close(critic, (errors[0] + g * errors[1] + g**2 * errors[2]).mean() / 3)


def test_the_actors_returns_are_divided_by_their_range():
    batch, found = make_batch(1, 2), {}
    for scaled in (False, True):
        ours = agent(scale_returns=scaled)
        if scaled:
            ours.return_scale.percentiles.copy_(torch.tensor([-300.0, 100.0]))
        ours.eval()
        filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
        torch.manual_seed(3)
        found[scaled] = ours.control_losses(filtered, batch.mask)

    (actor, critic), (scaled_actor, same_critic) = found[False], found[True]
    torch.testing.assert_close(scaled_actor, actor / 400)
    torch.testing.assert_close(same_critic, critic)


def test_the_slow_critic_is_the_critics_moving_average():
    ours, batch = agent(slow_critic=0.25), make_batch()
    start = [parameter.clone() for parameter in ours.slow_critic.parameters()]
    torch.nn.init.ones_(ours.critic.net[1].weight)

    ours.on_train_batch_end(None, batch, 0)

    for before, fast, slow in zip(start, ours.critic.parameters(), ours.slow_critic.parameters(), strict=True):
        torch.testing.assert_close(slow.data, 0.75 * before + 0.25 * fast)
        assert not slow.requires_grad
    assert not {*ours.slow_critic.parameters()} & {p for group in ours.groups() for p in group.parameters}


def test_the_critic_is_held_to_its_slow_average():
    """Where the average says 7 and the returns are 0, the best value is half way; without it, that of the returns."""
    best = {}
    for rate in (0.0, 1e-9):
        ours, batch = agent(slow_critic=rate), make_batch()
        filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
        for head, value in ((ours.reward, 0.0), (ours.critic, 0.0), (ours.slow_critic, 7.0)):
            if head is not None:
                torch.nn.init.zeros_(head.net[1].weight)
                torch.nn.init.constant_(head.net[1].bias, value)
        _, loss = ours.control_losses(filtered, batch.mask)
        best[rate] = -gradients(loss, [ours.critic.net[1]])[1].item() / sum(0.99**k for k in range(3)) * 3

    assert best[0.0] == pytest.approx(0, abs=1e-6)
    assert best[1e-9] == pytest.approx(7, rel=1e-5)  # the negative gradient of v²/2 + (v - 7)²/2 at 0


def test_two_hot_rewards_and_values_learn_from_the_codes():
    ours, batch = agent(two_hot=True), make_batch()

    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    reward = ours.log_probs(filtered, batch)["reward"]

    torch.testing.assert_close(reward, -ours.reward.error(filtered.features, batch.reward))
    assert type(ours.critic) is type(ours.reward) is TwoHotHead
    for part in gradients(loss_of(ours, batch), [ours.reward.net[1], ours.critic.net[1]]):
        assert part.abs().max() > 0
    with pytest.raises(ForbesError, match=r"reward_std is 0.1 with two_hot, which has none"):
        agent(two_hot=True, reward_std=0.1)


@pytest.mark.parametrize("rate", [-0.1, 1.1])
def test_refuses_shares_that_are_none(rate):
    for name in ("slow_critic", "discount", "lambda_"):
        with pytest.raises(ForbesError, match=f"{name} is {rate}, expected 0 to 1"):
            agent(**{name: rate})


@pytest.mark.parametrize("side", [-1, 1])
def test_entropy_reward_brings_an_actor_back_from_the_border(side):
    """Where mean and spread say +-1 without a doubt, what the action earns has no slope left."""
    ours, batch = agent(trajectories=1), make_batch()
    with torch.no_grad():
        ours.actor.head.weight.zero_()
        ours.actor.head.bias.copy_(torch.tensor([side * 14.0, -14.0]))  # mean 4.96, standard deviation 2e-4
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    slope = {}
    for ours.actor_entropy in (0.0, 1e-2):
        loss, _ = ours.control_losses(filtered, batch.mask)
        slope[ours.actor_entropy] = side * torch.autograd.grad(loss, ours.actor.head.bias)[0][0]

    assert slope[1e-2] > 10 * abs(slope[0.0])


def test_padding_does_not_change_the_control_losses():
    ours, batch = agent(trajectories=2), make_batch()
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    batch.mask[:, 3:] = False
    losses = []
    for rubbish in (9.0, -7.0):
        padded = type(filtered)(*(values.clone() for values in filtered))
        for values in padded:
            values[:, 3:] = rubbish
        torch.manual_seed(3)
        losses.append(ours.control_losses(padded, batch.mask))

    torch.testing.assert_close(losses[0], losses[1])


def train(ours, batch_of):
    optimizer = ours.configure_optimizers()["optimizer"]
    for update in range(250):
        torch.manual_seed(update)
        optimizer.zero_grad()
        ours.training_step(batch_of(update), 0).backward()
        optimizer.step()


@pytest.mark.parametrize(("belief", "trajectories"), [(GaussianBelief, 1), (partial(FlowBelief, layers=1, width=4), 2)])
def test_learns_the_action_that_pays(belief, trajectories):
    """What pays depends on what is seen; rewards or actions one step aside would be noise, and teach nothing."""
    options = {"hidden_dim": 16, "mlp_dim": 16, "control_dim": 16, "horizon": 3, "discount": 0.5}
    rates = {"learning_rate": 1e-2, "actor_rate": 3e-3, "critic_rate": 3e-3}
    ours = agent(belief=belief, trajectories=trajectories, **options, **rates)
    train(ours, lambda update: make_batch(16, 6, update))

    with torch.no_grad():
        batch = make_batch(100, 6, seed=-1)
        filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
        action, _ = ours.actor(filtered.features).rsample()
    clear = batch.observation.abs() > 0.3

    assert (action * batch.observation < 0)[clear].float().mean() > 0.9  # half of them without any learning


@pytest.mark.parametrize("discrete", [True, (2, 2)], ids=["one choice", "two choices"])
def test_learns_the_discrete_action_that_pays(discrete):
    """The other one of two than the last pays; straight-through gradients must know which of them was drawn."""
    number = 1 if discrete is True else 2
    options = {"control_dim": 16, "horizon": 3, "discount": 0.5, "trajectories": 1}
    rates = {"learning_rate": 1e-2, "actor_rate": 3e-3, "critic_rate": 3e-3, "discrete": discrete}
    sizes = {"observation_shape": (2 * number,), "action_dim": 2 * number, "state_dim": 2 * number}
    sizes |= {"hidden_dim": 16 * number, "mlp_dim": 16 * number}
    ours = agent(**sizes, **options, **rates)
    train(ours, lambda update: one_of_two(16, 6, update, number))

    with torch.no_grad():
        batch = one_of_two(100, 6, -1, number)
        filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
        action = ours.actor(filtered.features).rsample()[0]

    another = (action * batch.observation).unflatten(-1, (number, 2)).sum(-1) == 0  # (B, T, number)
    assert (another[:, 1:].float().mean((0, 1)) > 0.9).all()  # half without any learning


def one_of_two(batch, time, seed, number):
    """One-hot actions, seen as they are: the reward is 1 for another than the last, else -1; of several, their sum."""
    generator = torch.Generator().manual_seed(seed)
    choice = torch.randint(2, (batch, time, number), generator=generator)
    action = torch.nn.functional.one_hot(choice, 2).flatten(-2).float()
    action[:, 0] = 0
    reward = number - 2 * (action * action.roll(1, 1)).sum(-1)
    reward[:, :2] = 0
    return batch_of(action.clone(), action, reward)


def test_never_predicting_an_end_equals_having_no_prediction():
    ours, batch = agent(continuation=True), make_batch()
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    losses = []
    for head in (saturate(ours.continues, 50.0), None):
        ours.continues = head
        torch.manual_seed(3)
        losses.append(ours.control_losses(filtered, batch.mask))

    torch.testing.assert_close(losses[0], losses[1])


def test_predicting_the_end_at_once_pays_only_the_first_reward():
    ours, batch = agent(continuation=True, trajectories=1), make_batch(1, 1)
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    saturate(ours.continues, -50.0)
    torch.manual_seed(3)
    actor, critic = ours.control_losses(filtered, batch.mask)

    torch.manual_seed(3)
    sample_starts(ours.model, filtered, 1)
    action, _ = ours.actor(filtered.features[:, 0]).rsample()
    state = ours.model.imagine(State(filtered.hidden[:, 0], filtered.state[:, 0]), action[:, None]).features[0, 0]
    torch.testing.assert_close(actor, -ours.reward(state) / 3)
    torch.testing.assert_close(critic, (ours.critic(state) - ours.reward(state)) ** 2 / 2 / 3)


def saturate(head, logit):
    with torch.no_grad():
        head.net[-1].weight.zero_()
        head.net[-1].bias.fill_(logit)
    return head


def test_learns_where_episodes_end():
    """An observation above 0.5 is the last of its episode; the rest is padding, on which nothing is learned."""
    ours = agent(continuation=True, learning_rate=1e-2)
    train(ours, lambda update: until_high(16, 6, update))

    batch = until_high(200, 6, seed=-1)
    filtered = ours.model.filter(ours.model.embed(batch.observation), batch.action)
    foreseen = ours.continues(filtered.features) < 0

    clear = batch.mask & ((batch.observation[..., 0] - 0.5).abs() > 0.2)
    assert (foreseen == batch.ended)[clear].float().mean() > 0.95
    assert 0.1 < batch.ended[clear].float().mean() < 0.5


def until_high(batch, time, seed):
    whole = make_batch(batch, time, seed)
    high = whole.observation[..., 0] > 0.5  # (B, T)
    before = high.cumsum(1) - high.long()  # (B, T), ends before that step
    return whole._replace(mask=before == 0, ended=high & (before == 0))


def test_nothing_is_imagined_from_where_an_episode_has_ended():
    ours, batch = agent(trajectories=2), make_batch()
    ended = torch.zeros_like(batch.mask)
    ended[:, -1] = True
    seen = []
    ours.control_losses = lambda filtered, begins: seen.append(begins) or (torch.zeros(()), torch.zeros(()))

    ours.training_step(batch._replace(ended=ended), 0)

    assert torch.equal(seen[0], ~ended)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"trajectories": 0}, "trajectories is 0, expected at least 1"),
        ({"horizon": 1}, "horizon is 1, expected at least 2"),
        ({"actor_entropy": -1.0}, "actor_entropy is -1.0, expected at least 0"),
        ({"actor_rate": float("nan")}, "actor_rate is nan, expected at least 0"),
        ({"reward_std": 0.0}, "reward_std is 0.0, expected a number above 0"),
        ({"action_dim": 0}, "the data have no actions"),
        ({"action_dim": 3, "discrete": (2, 2)}, r"discrete is \(2, 2\), expected .* add up to action_dim, 3"),
    ],
)
def test_refuses_what_cannot_be(options, message):
    with pytest.raises(ForbesError, match=message):
        agent(**options)


def test_without_reward_and_control_it_is_the_world_model():
    """The same weights, and the same bound."""
    ours = agent()
    torch.manual_seed(0)
    world = WorldModel(**SMALL)

    torch.testing.assert_close(dict(ours.model.state_dict()), dict(world.model.state_dict()))
