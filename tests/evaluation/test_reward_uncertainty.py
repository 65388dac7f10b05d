"""The uncertainty of the reward: that of the exact belief in closed form, and what an agent has of it."""

import math

import pytest
import torch
from small_agents import fit, forbes, write_config
from torch import nn

from forbes.data.episodes.collection import play, random_policy
from forbes.envs.known_process import KnownProcess
from forbes.evaluation.agent_beliefs import DRAWS, exact_variance, learned_variance, uncertainty
from forbes.evaluation.record import read_record
from forbes.models import Filtered
from forbes.pomdps import MountainHike, Tiger, TMaze


class Coordinates(MountainHike):
    """A hike that pays the sum of the coordinates, whose variance is the belief's own."""

    def reward(self, state, action, next_state):
        return next_state.sum(-1)


class Returns(MountainHike):
    """A hike that pays what a step has added, so that the states before and after count together."""

    def reward(self, state, action, next_state):
        return (next_state - state).sum(-1)


def episode_of(process, steps=30):
    environment = KnownProcess(process, steps)
    return play(environment, random_policy(environment, 0), seed=0)


def inputs(process, episode):
    taken = process.action_scale * torch.from_numpy(episode.action).double()
    return torch.from_numpy(episode.observation).double()[None], taken[None]


def test_a_linear_rewards_variance_is_that_of_the_kalman_filter():
    process = Coordinates(observation_std=0.1)
    episode = episode_of(process)
    exact = process.exact_filter(*inputs(process, episode)).belief.variance[0, 1:].sum(-1)

    drawn = torch.stack([exact_variance(process, episode, seed) for seed in range(40)]).mean(0)

    # A variance of K draws is off by sqrt(2 / K) of itself; 3 times that for the weights, 5 standard errors of 40.
    torch.testing.assert_close(drawn, exact, rtol=5 * 3 * math.sqrt(2 / DRAWS / 40), atol=0)


def test_a_step_is_uncertain_by_its_noise_less_what_is_seen():
    """Var[s_t - s_t-1 | o_1:t]: the noise of the step, less what the last observation tells about it."""
    process = Returns(observation_std=0.1)
    episode = episode_of(process)
    noise, seen = 0.025**2, 0.1**2
    before = process.exact_filter(*inputs(process, episode)).belief.variance[0, :-1]
    exact = (noise - noise**2 / (before + noise + seen)).sum(-1)

    drawn = torch.stack([exact_variance(process, episode, seed) for seed in range(40)]).mean(0)

    torch.testing.assert_close(drawn, exact, rtol=5 * 3 * math.sqrt(2 / DRAWS / 40), atol=0)


def test_a_tiger_behind_a_door_that_is_known_pays_what_is_known():
    process = Tiger(accuracy=1.0)
    environment = KnownProcess(process, 3)
    environment.reset(0)
    listen, open_left = torch.eye(3)[:2].numpy()
    actions = iter((listen, open_left, open_left))
    episode = play(environment, lambda _: next(actions), seed=0)

    variance = exact_variance(process, episode, 0)

    assert variance[:2].max() < 1e-20  # it was heard, so the first door is no gamble
    assert variance[2] == pytest.approx(55**2, rel=0.05)  # -100 or 10 by halves


class Believer(nn.Module):
    """An agent whose state is a draw of the process's exact belief, or its mean, and which knows what places pay."""

    def __init__(self, process, draws):
        super().__init__()
        self.model, self.process, self.draws = self, process, draws
        self.still = nn.Parameter(torch.zeros(process.action_dim, dtype=torch.float64))

    def embed(self, observation):
        return observation

    def filter(self, embedding, action):
        taken = self.process.action_scale * action[:1].double()
        belief = self.process.exact_filter(embedding[:1].double(), taken).belief
        draw = torch.Generator().manual_seed(1)
        state = belief.sample(len(embedding), draw)[:, 0] if self.draws else belief.mean.expand(len(embedding), -1, -1)
        return Filtered(state[..., :0], state, state, state[..., 0])

    def reward(self, features):
        return self.process.reward(features, self.still, features)


@pytest.mark.parametrize("start", ["single", "multi"])
def test_uncertainty_is_1_for_an_exact_belief_and_0_for_a_mean(start):
    process = MountainHike(start, observation_std=1.5)
    episodes = [episode_of(process) for _ in range(3)]
    exact = [exact_variance(process, episode, seed) for seed, episode in enumerate(episodes)]

    shares = [
        uncertainty([learned_variance(Believer(process, draws), one, 0) for one in episodes], exact).mean
        for draws in (True, False)
    ]

    assert shares[0] == pytest.approx(1, abs=5 * 2 * math.sqrt(2 / DRAWS))
    assert shares[1] == 0


def test_evaluate_says_it_of_a_known_process_and_of_nothing_else(tmp_path, capsys):
    hike = ("--data.source.task", "multi_start_hike", "--data.source.options")
    blind = "{shows: nothing}"
    for name, task in {"hike": (*hike, "{}"), "blind": (*hike, blind), "parrot": ()}.items():
        small = ("--config", write_config(tmp_path, "dreamer"), "--trainer.max_epochs", 1, "--run_dir", tmp_path / name)
        assert fit(*small, *task) == 0
    capsys.readouterr()

    assert forbes("evaluate", tmp_path / "hike", tmp_path / "blind", "--episodes", 2) == 0
    assert "variance of the reward it has just observed" in " ".join(capsys.readouterr().out.split())
    key = "reward_uncertainty[episodes=2]"
    record = read_record(str(tmp_path / "hike"))
    assert record[key]["mean"] > 0
    assert record[key]["command"].startswith("forbes --allow-module toy_environments evaluate")
    assert key not in read_record(str(tmp_path / "blind"))

    assert forbes("evaluate", tmp_path / "parrot", "--episodes", 2) == 0
    assert key not in read_record(str(tmp_path / "parrot"))


def test_where_every_reward_is_certain_there_is_no_ratio():
    """In the T-maze the exact belief is a point: the sum of its variances is rounding, and the ratio was 1e30."""
    episode = episode_of(TMaze())
    exact = exact_variance(TMaze(), episode, 0)

    assert uncertainty([torch.full_like(exact, 1e-3)] * 2, [exact] * 2) is None
