"""An agent's episode: what it remembers, and what its choices depend on."""

import numpy as np
import pytest
import torch

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.control.agent import Agent, explore, follow_plan, greedy
from forbes.control.planning import CrossEntropy
from forbes.control.policy import Actor
from forbes.models import MLPDecoder, MLPEncoder, ModelParts, StateSpaceModel, VectorNormal

OBSERVATIONS = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)


def build(belief=GaussianBelief):
    torch.manual_seed(0)
    networks = {"encoder": MLPEncoder((3,), 8, 1), "decoder": MLPDecoder(16 + 4, (3,), 8, 1)}
    sizes = {"action_dim": 2, "state_dim": 4, "hidden_dim": 16, "mlp_dim": 8, "mlp_layers": 1}
    model = StateSpaceModel(ModelParts(belief, likelihood=VectorNormal(), **networks, **sizes))
    return model.eval(), Actor(20, 2, 8, 1)


def search():
    return CrossEntropy(horizon=2, iterations=2, candidates=20, best=5)


def choices(model, actor):
    return {
        "mode": greedy(actor),
        "explore": explore(actor, 0.3),
        "plan": follow_plan(model, lambda features: features.sum(-1), search()),
    }


@pytest.mark.parametrize("belief", [GaussianBelief, FlowBelief])
@pytest.mark.parametrize("kind", ["mode", "explore", "plan"])
def test_an_episode_depends_on_its_seed_only(belief, kind):
    model, actor = build(belief)
    choose = choices(model, actor)[kind]

    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    first, again, other = (Agent(model, choose, seed) for seed in (1, 1, 2))
    actions = [[agent(o) for o in OBSERVATIONS] for agent in (first, again, other)]

    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.array_equal(actions[0], actions[2])
    assert np.shape(actions[0]) == (6, 2)
    assert np.abs(actions[0]).max() <= 1
    assert np.asarray(actions[0]).dtype == np.float32
    assert torch.equal(torch.random.get_rng_state(), before)  # and nothing else notices


def test_the_belief_is_that_of_filtering_the_whole_episode():
    """Step by step, the recurrence sees the same states and the actions that were taken."""
    model, actor = build()
    seen = []

    def choose(filtered):
        seen.append(filtered)
        return greedy(actor)(filtered)

    agent = Agent(model, choose, seed=1)
    actions = torch.tensor(np.stack([agent(o) for o in OBSERVATIONS]))

    hidden = torch.zeros(1, 16)
    state, action = torch.zeros(1, 4), torch.zeros(1, 2)
    for step, filtered in enumerate(seen):
        hidden = model.gru(model.transition(torch.cat((state, action), -1)), hidden)
        torch.testing.assert_close(filtered.hidden[:, 0], hidden)
        context = model.posterior_context(
            torch.cat((hidden, model.encoder(torch.tensor(OBSERVATIONS[None, step]))), -1)
        )
        torch.testing.assert_close(filtered.context[:, 0], context)
        state, action = filtered.state[:, 0], actions[None, step]


def test_what_was_seen_long_ago_matters():
    model, actor = build()
    one, other = (Agent(model, greedy(actor), seed=1) for _ in range(2))
    changed = OBSERVATIONS.copy()
    changed[0] += 3

    for o, other_o in zip(OBSERVATIONS, changed, strict=True):
        one(o), other(other_o)

    assert (one.belief.hidden - other.belief.hidden).abs().max() > 1e-4


class Upwards:
    """Goes up where the state is above 0, else down."""

    def __init__(self, discrete):
        self.discrete = discrete

    def __call__(self, features):
        up = features[:, 16:18] > 0  # the first two dimensions of s, after 16 of h
        self.action = torch.stack((up[:, 0], ~up[:, 0]), 1).float() if self.discrete else 2 * up.float() - 1  # (K, 2)
        return self

    def mode(self):
        return self.action


def test_many_trajectories_act_on_the_belief_and_not_on_a_guess():
    r"""After one observation the belief is N(μ, σ²): the mean action goes to 2 Φ(μ/σ) - 1, where one guess has ±1."""
    model, _ = build()
    guess, many = (Agent(model, greedy(Upwards(discrete=False)), 0, samples) for samples in (1, 10_000))

    assert set(np.abs(guess(OBSERVATIONS[0]))) == {1.0}
    action = torch.from_numpy(many(OBSERVATIONS[0]))

    hidden = model.gru(model.transition(torch.zeros(1, 6)), torch.zeros(1, 16))
    embedding = model.encoder(torch.tensor(OBSERVATIONS[None, 0]))
    mean, std = model.posterior.moments(model.posterior_context(torch.cat((hidden, embedding), -1)))
    torch.testing.assert_close(action, torch.erf(mean / std / 2**0.5)[0, :2], atol=5 / 10_000**0.5, rtol=0)
    many(OBSERVATIONS[1])
    assert many.belief.hidden.std(0).min() > 0  # each goes on from its own state


def test_many_trajectories_vote_for_the_discrete_action():
    model, _ = build()
    agent = Agent(model, greedy(votes := Upwards(discrete=True)), 0, samples=9)

    for observation in OBSERVATIONS:
        action = agent(observation)
        counts = votes.action.sum(0).numpy()
        assert counts.sum() == 9
        np.testing.assert_array_equal(action, counts == counts.max())


class Voters:
    """Each of three trajectories has its own opinion on two choices, of 3 and of 2."""

    discrete = (3, 2)

    def __call__(self, features):
        return self

    def mode(self):
        return torch.tensor([[1.0, 0, 0, 0, 1], [0, 0, 1, 1, 0], [0, 0, 1, 0, 1]])


def test_every_choice_is_voted_on_by_itself():
    model, _ = build()
    model.action_dim = 5
    filtered = model.filter(model.embed(torch.zeros(3, 1, 3)), torch.zeros(3, 1, 2))

    assert greedy(Voters())(filtered).tolist() == [[0, 0, 1, 0, 1]]  # which none of them would take


@pytest.mark.parametrize("trajectories", [1, 3])
def test_every_candidate_plan_is_tried_on_a_draw_of_its_own(trajectories):
    """20 candidates take turns on the trajectories, each from (h, s) with another s of that trajectory's belief."""
    model, _ = build()
    seen = torch.from_numpy(OBSERVATIONS)[None].expand(trajectories, -1, -1)  # (K, T, 3)
    filtered = model.filter(model.embed(seen), torch.zeros(trajectories, 6, 2))
    last = type(filtered)(*(values[:, -1:] for values in filtered))  # (K, 1, ...)
    imagine, starts = model.imagine, []
    model.imagine = lambda start, *others: [starts.append(start), imagine(start, *others)][1]

    follow_plan(model, lambda features: features.sum(-1), search())(last)

    start = starts[0]
    assert start.state.flatten().unique().numel() == start.state.numel() == 20 * 4
    assert torch.equal(start.hidden, last.hidden[:, 0].repeat(20, 1)[:20])


def test_a_plan_may_spread_its_candidates_over_trajectories():
    """20 candidates on 3 trajectories, which share their actions but not their states."""
    model, actor = build()
    agent = Agent(model, choices(model, actor)["plan"], seed=1, samples=3)

    actions = np.stack([agent(o) for o in OBSERVATIONS])

    assert actions.shape == (6, 2)
    assert np.abs(actions).max() <= 1
    assert len(agent.belief.state.unique(dim=0)) == 3


def test_exploration_adds_noise_of_its_size_and_stays_in_bounds():
    """A policy that is almost certain of 0: what is left is the noise."""
    model, actor = build()
    torch.nn.init.zeros_(actor.head.weight)
    actor.head.bias.data = torch.tensor([0.0, 0.0, -50.0, -50.0])  # standard deviation 1e-4

    actions = np.stack([Agent(model, explore(actor, 0.3), seed)(OBSERVATIONS[0]) for seed in range(400)])  # (400, 2)

    assert abs(actions.std() / 0.3 - 1) < 4 / np.sqrt(2 * 800)  # relative s.e. of a standard deviation of 800 draws
    wild = np.stack([Agent(model, explore(actor, 9.0), seed)(OBSERVATIONS[0]) for seed in range(20)])
    assert np.abs(wild).max() == 1


@pytest.mark.parametrize("chance", [0.0, 0.5, 1.0])
def test_an_explorer_of_discrete_actions_takes_any_so_often(chance):
    """Its own policy always takes the first of two; any of both is the other one half of the time."""
    model, _ = build()
    actor = Actor(20, 2, 8, 1, discrete=True)
    with torch.no_grad():
        actor.head.weight.zero_()
        actor.head.bias.copy_(torch.tensor([50.0, -50.0]))
    agent = Agent(model, explore(actor, chance), seed=0)

    actions = np.array([agent(OBSERVATIONS[0]) for _ in range(400)])

    assert set(map(tuple, actions)) <= {(1.0, 0.0), (0.0, 1.0)}
    expected = chance / 2
    assert abs(actions[:, 1].mean() - expected) <= 5 * (expected * (1 - expected) / 400) ** 0.5


def test_an_explorer_of_several_choices_draws_all_of_them_at_once():
    """Its own policy always takes (0, 0); of 2 x 3 actions any is equally probable in half of the steps."""
    model, _ = build()
    filtered = model.filter(model.embed(torch.zeros(1, 1, 3)), torch.zeros(1, 1, 2))
    actor = Actor(20, 5, 8, 1, discrete=(2, 3))
    with torch.no_grad():
        actor.head.weight.zero_()
        actor.head.bias.copy_(torch.tensor([50.0, -50.0, 50.0, -50.0, -50.0]))
    torch.manual_seed(0)

    actions = torch.cat([explore(actor, 0.5)(filtered) for _ in range(1200)]).detach()

    cells = (actions[:, :2, None] * actions[:, None, 2:]).mean(0)  # (2, 3)
    expected = torch.full((2, 3), 0.5 / 6)
    expected[0, 0] += 0.5
    assert cells.sum() == pytest.approx(1)
    assert ((cells - expected).abs() < 5 * (expected * (1 - expected) / 1200).sqrt()).all()
