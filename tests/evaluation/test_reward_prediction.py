"""Reward prediction of a world model: exact for models that know everything, or only the mean."""

import shutil

import numpy as np
import pytest
import torch
from small_agents import forbes
from torch import nn

from forbes.data.episodes.episode import Episode
from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.record import read_record
from forbes.evaluation.reward_prediction import STEPS_AHEAD, predict_rewards, r2_by_steps_ahead
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
def test_a_model_that_knows_the_world_predicts_each_reward(steps):
    """A shift by one step, of actions, rewards or beliefs, would show: no two steps are alike."""
    episodes = [walk(steps, seed) for seed in range(3)]

    predicted = [predict_rewards(Walk(torch.square), episode, number, "") for number, episode in enumerate(episodes)]

    for by_ahead, episode in zip(predicted, episodes, strict=True):
        assert tuple(by_ahead) == STEPS_AHEAD
        for ahead, rewards in by_ahead.items():
            first = max(ahead - 1, 0)  # o_1 is before r_2, so that there is a belief 1 step before it
            torch.testing.assert_close(rewards, paid(episode)[first:], rtol=1e-4, atol=1e-4)
    for r2 in r2_by_steps_ahead(predicted, [paid(episode) for episode in episodes]).values():
        assert r2 == pytest.approx((1, 0), abs=1e-6)


def test_a_model_blind_to_actions_predicts_near_rewards_better():
    episodes = [walk(40, seed) for seed in range(5)]

    predicted = [
        predict_rewards(Walk(torch.square, drift=0.0), episode, number, "") for number, episode in enumerate(episodes)
    ]
    r2 = [r2.mean for r2 in r2_by_steps_ahead(predicted, [paid(episode) for episode in episodes]).values()]

    assert r2[0] == pytest.approx(1)
    assert r2 == sorted(r2, reverse=True)
    assert r2[-1] < 0.5


def test_the_mean_has_an_r2_of_zero_and_worse_predictions_less():
    rewards = [torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([2.0, 4.0]).double()]
    mean = torch.cat(rewards).mean()
    predicted = [dict.fromkeys(STEPS_AHEAD, mean.expand(len(reward))) for reward in rewards]
    worse = [{ahead: prediction + 1 for ahead, prediction in by_ahead.items()} for by_ahead in predicted]

    assert [r2.mean for r2 in r2_by_steps_ahead(predicted, rewards).values()] == pytest.approx([0] * len(STEPS_AHEAD))
    assert all(r2.mean < 0 for r2 in r2_by_steps_ahead(worse, rewards).values())


def test_there_is_no_r2_of_short_episodes_or_equal_rewards():
    short = [walk(6, seed) for seed in range(2)]
    predicted = [predict_rewards(Walk(torch.square), episode, 0, "") for episode in short]

    r2 = r2_by_steps_ahead(predicted, [paid(episode) for episode in short])
    assert [ahead for ahead, estimate in r2.items() if estimate is None] == [15]

    level = [torch.ones(20).double()] * 2
    same = r2_by_steps_ahead([dict.fromkeys(STEPS_AHEAD, level[0])] * 2, level)
    assert same == dict.fromkeys(STEPS_AHEAD)


def test_a_predicted_reward_that_is_not_finite_is_an_error():
    with pytest.raises(ForbesError, match="run, test episode 7: the world model predicts rewards that are not finite"):
        predict_rewards(Walk(lambda place: place / 0), walk(6), 0, "run, test episode 7")


def test_a_measurement_is_recorded_and_repeated(small_agent, tmp_path, capsys):
    shutil.copytree(small_agent, tmp_path / "run")
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
