"""How much of the reward a world model foresees: exact for models that know all, or only the mean."""

import numpy as np
import pytest
import torch
from small_agents import fit, forbes, write_config
from torch import nn

from forbes.data.episodes.episode import Episode
from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.record import read_record
from forbes.evaluation.reward_prediction import STEPS_AHEAD, explained, predict_rewards
from forbes.models import Filtered, Rollout, State


class Walk(nn.Module):
    """A world whose state is where the walker is, o_t, and whose reward is a function of it; the actions are steps."""

    def __init__(self, pay, drift=1.0):
        super().__init__()
        self.drift, self.reward = nn.Parameter(torch.tensor(drift)), lambda features: pay(features[..., -1])
        self.model = self

    def embed(self, observation):
        return observation

    def filter(self, embedding, action):
        return Filtered(torch.zeros_like(embedding), embedding, embedding, embedding[..., 0])

    def imagine(self, start: State, action):
        state = start.state[:, None] + self.drift * action.cumsum(1)
        return Rollout(torch.zeros_like(state), state, state[..., 0])


def walk(steps, seed=0, pay=torch.square):
    action = np.random.default_rng(seed).normal(size=(steps + 1, 1)).astype(np.float32)
    action[0] = 0
    place = action.cumsum(0)
    reward = pay(torch.from_numpy(place[:, 0])).numpy()
    reward[0] = 0
    return Episode(place, action, reward, terminated=False, frames=steps)


def paid(episode):
    return torch.from_numpy(episode.reward[1:]).double()


@pytest.mark.parametrize("steps", [16, 40])
def test_who_knows_the_world_foretells_each_reward_at_every_distance(steps):
    """A shift by one step, of actions, rewards or beliefs, would show: no two steps are alike."""
    episodes = [walk(steps, seed) for seed in range(3)]

    foretold = [predict_rewards(Walk(torch.square), episode, number, "") for number, episode in enumerate(episodes)]

    for told, episode in zip(foretold, episodes, strict=True):
        for one, distance in zip(told, STEPS_AHEAD, strict=True):
            first = max(distance - 1, 0)  # o_1 is before r_2, so that a belief 1 step before it is there
            torch.testing.assert_close(one, paid(episode)[first:], rtol=1e-4, atol=1e-4)
    for share in explained(foretold, [paid(episode) for episode in episodes]):
        assert share == pytest.approx((1, 0), abs=1e-6)


def test_who_does_not_know_what_actions_do_foretells_the_nearer_the_better():
    episodes = [walk(40, seed) for seed in range(5)]

    told = [
        predict_rewards(Walk(torch.square, drift=0.0), episode, number, "") for number, episode in enumerate(episodes)
    ]
    shares = [share.mean for share in explained(told, [paid(episode) for episode in episodes])]

    assert shares[0] == pytest.approx(1)
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] < 0.5


def test_the_mean_explains_nothing_and_what_is_further_off_less_than_that():
    rewards = [torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([2.0, 4.0]).double()]
    mean = torch.cat(rewards).mean()
    told = [[mean.expand(len(one))] * len(STEPS_AHEAD) for one in rewards]

    assert [share.mean for share in explained(told, rewards)] == pytest.approx([0] * len(STEPS_AHEAD))
    assert all(share.mean < 0 for share in explained([[guess + 1 for guess in one] for one in told], rewards))


def test_no_share_where_no_episode_is_long_enough_or_all_rewards_are_equal():
    short = [walk(6, seed) for seed in range(2)]
    told = [predict_rewards(Walk(torch.square), episode, 0, "") for episode in short]

    assert [share is None for share in explained(told, [paid(episode) for episode in short])] == [False] * 3 + [True]

    level = [torch.ones(20).double()] * 2
    assert explained([[level[0]] * len(STEPS_AHEAD)] * 2, level) == [None] * len(STEPS_AHEAD)


def test_a_reward_that_is_not_a_number_is_said():
    with pytest.raises(ForbesError, match="run, test episode 7: the world model foretells rewards that are not finite"):
        predict_rewards(Walk(lambda place: place / 0), walk(6), 0, "run, test episode 7")


def test_a_measurement_is_recorded_and_repeated(tmp_path, capsys):
    assert fit("--config", write_config(tmp_path), "--run_dir", tmp_path / "run", "--trainer.max_epochs", 1) == 0
    names = [f"reward_explained[ahead={distance},S=16,episodes=3]" for distance in (0, 1, 5)]

    assert forbes("evaluate", tmp_path / "run", "--episodes", 3) == 0
    first = read_record(tmp_path / "run")
    assert forbes("evaluate", tmp_path / "run", "--episodes", 3) == 0
    again = read_record(tmp_path / "run")

    printed = capsys.readouterr().out
    for name in names:
        assert first[name]["mean"] == again[name]["mean"]
        assert first[name]["checkpoint"]
        assert str(Estimate(first[name]["mean"], first[name]["standard_error"])) in printed
    assert not any("ahead=15" in name for name in first)  # an episode has 8 steps
    assert "n/a" in printed
