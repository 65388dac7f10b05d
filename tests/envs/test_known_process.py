"""Known processes as environments: an episode has the law of the process, and rewards are the sources' numbers."""

import math

import numpy as np
import pytest
import torch

from forbes.data.episodes.collection import play, random_policy
from forbes.envs import find_environment
from forbes.envs.known_process import KnownProcess
from forbes.errors import ForbesError
from forbes.pomdps import MirrorSensor, MountainHike, Tiger, TMaze

RIGHT, UP, LEFT, DOWN = np.eye(4, dtype=np.float32)
LISTEN, OPEN_LEFT, OPEN_RIGHT = np.eye(3, dtype=np.float32)


@pytest.mark.parametrize("task", ["mountain_hike", "multi_start_hike", "t_maze", "tiger"])
def test_a_seed_is_an_episode(task):
    environment = find_environment(task)()

    first, other, again = (play(environment, random_policy(environment, seed), seed) for seed in (5, 6, 5))

    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_an_episode_is_as_likely_as_a_draw_of_the_process():
    """The evidence of both has the same mean: an action one step aside, or in other units, costs many nats."""
    process, environment, steps = MountainHike(), find_environment("mountain_hike")(), 75
    # All chance of a hike is Gaussian, whatever the actions, so each step's evidence has the same law.
    episodes = [play(environment, random_policy(environment, seed), seed) for seed in range(40)]
    observation = torch.from_numpy(np.stack([episode.observation for episode in episodes])).double()
    action = process.action_scale * torch.from_numpy(np.stack([episode.action for episode in episodes])).double()
    drawn = process.sample(400, steps + 1, torch.Generator().manual_seed(0))

    ours = process.log_likelihood(observation, action)
    theirs = process.log_likelihood(drawn.observation, drawn.action)

    error = math.sqrt(ours.var() / len(ours) + theirs.var() / len(theirs))
    assert abs(ours.mean() - theirs.mean()) < 4 * error
    for aside in (
        torch.cat((action[:, :1], action[:, :-1]), 1),
        torch.cat((action[:, :1], action[:, 2:], action[:, 1:2]), 1),
    ):
        loss = ours - process.log_likelihood(observation, aside)
        assert loss.mean() > 4 * loss.std() / math.sqrt(len(loss))


def test_the_height_of_the_hike_is_that_of_its_sources():
    """By hand: on the crest of the ridge at (0.5, 0.5), far from all ridges, and outside."""
    crest = 1 / (3 * 2 * math.pi * 0.75 * 0.1)
    places = torch.tensor([[0.5, 0.5], [-0.9, 0.9], [1.1, 0.0]], dtype=torch.float64)
    action = torch.tensor([[0.0, 0.0], [0.03, 0.04], [0.3, 0.4]], dtype=torch.float64)

    reward = MountainHike().reward(places, action, places)

    assert reward[0].item() == pytest.approx(4 * (1 - (1 - crest) ** 4) - 4.5 + 0.25, abs=1e-12)
    assert reward[1].item() == pytest.approx(-4.5 - 0.1 * 0.05, abs=1e-3)  # a ridge's density is below 1e-4 there
    assert reward[2].item() == -6 - 0.1 * 0.5


def test_the_hike_is_rewarded_for_where_it_arrives():
    process = MountainHike()
    start, end = torch.tensor([[-0.85, -0.85]]).double(), torch.tensor([[0.5, 0.5]]).double()
    still = torch.zeros(1, 2, dtype=torch.float64)

    assert process.reward(start, still, end) == process.reward(end, still, end)


@pytest.mark.parametrize("seed", range(4))
def test_the_maze_pays_for_the_arm_that_the_sign_says(seed):
    environment = KnownProcess(TMaze(3), time_limit=30)
    up = environment.reset(seed).observation[0] == 1

    rewards = [environment.step(action).reward for action in (LEFT, RIGHT, UP, RIGHT, LEFT, RIGHT, RIGHT)]
    end = environment.step(UP)

    assert rewards == pytest.approx([-0.1, 0, -0.1, 0, 0, 0, 0])  # against two walls
    assert end.reward == pytest.approx(4.0 if up else -0.1)
    assert (end.terminated, end.truncated) == (True, False)
    assert environment.step(UP).reward == 0


def test_both_signs_are_shown():
    environment = find_environment("t_maze")()
    assert {environment.reset(seed).observation.argmax() for seed in range(20)} == {0, 1}


def test_the_tiger_costs_a_hundred_and_the_other_door_pays_ten():
    environment = KnownProcess(Tiger(accuracy=1.0), time_limit=5)
    for seed in range(4):
        environment.reset(seed)
        heard = environment.step(LISTEN)
        tiger_is_left = heard.observation[0] == 1

        assert heard.reward == -1
        assert environment.step(OPEN_LEFT).reward == (-100 if tiger_is_left else 10)
        tiger_is_left = environment.step(LISTEN).observation[0] == 1  # it was put behind a door again
        assert environment.step(OPEN_RIGHT).reward == (10 if tiger_is_left else -100)
        last = environment.step(LISTEN)
        assert (last.terminated, last.truncated) == (False, True)


def test_half_an_action_is_half_a_step():
    environment = KnownProcess(MountainHike(observation_std=0.03))
    gains = []
    for seed in range(300):
        before = environment.reset(seed)
        gains.append(environment.step(np.array([0.5, 0], np.float32)).observation - before.observation)

    mean, std = np.mean(gains, 0) / 10, np.std(gains, 0) / 10
    assert abs(mean - [0.025, 0]).max() < 4 * std.max() / math.sqrt(len(gains))
    assert 4 * std.max() / math.sqrt(len(gains)) < 0.02  # else a step of full length would pass, too


def test_a_process_without_rewards_is_one_sentence():
    environment = KnownProcess(MirrorSensor(cells=401))
    environment.reset(0)
    with pytest.raises(ForbesError, match=r"^MirrorSensor: has no rewards, expected a process with rewards"):
        environment.step(np.zeros(0, np.float32))


def test_names_that_are_nearly_right_are_suggested():
    with pytest.raises(ForbesError, match=r"^mountain_hik: no such task\. Did you mean mountain_hike\?$"):
        find_environment("mountain_hik")
    with pytest.raises(ForbesError, match=r"^tiger: its environment has no option camera\. Remove it$"):
        find_environment("tiger", camera=1)


def test_an_environment_of_a_forbidden_module_is_no_task():
    """It was taken for one of DeepMind Control, which lacked its options."""
    with pytest.raises(ForbesError, match=r"^Parakeet: no such task\..* needs --allow-module MODULE$"):
        find_environment("Parakeet", steps=8)


@pytest.mark.parametrize("task", ["mountain_hike", "multi_start_hike", "t_maze", "tiger"])
def test_showing_the_exact_belief_does_not_change_the_episode(task):
    """Beside the ordinary episode of the same seed and actions, whose observations are filtered at the end."""
    plain, shown = find_environment(task)(), find_environment(task, shows="exact_belief")()
    process = plain.process

    ordinary, believed = (play(environment, random_policy(environment, 3), 3) for environment in (plain, shown))

    for name in ("action", "reward"):
        np.testing.assert_array_equal(getattr(ordinary, name), getattr(believed, name))
    # the ordinary episode's numbers are float32, those that were filtered float64
    action = process.action_scale * torch.from_numpy(ordinary.action).double()
    belief = process.exact_filter(torch.from_numpy(ordinary.observation).double()[None], action[None]).belief
    if task in ("t_maze", "tiger"):
        expected = belief.mean[0]
    else:
        std = belief.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        expected = torch.cat((belief.log_weight[0].exp(), belief.component_mean[0].flatten(1), std), 1)
    np.testing.assert_allclose(believed.observation, expected, rtol=1e-4, atol=1e-5)


def test_refuses_to_show_a_belief_of_too_many_numbers():
    with pytest.raises(ForbesError, match="shows: the exact belief is a GridBelief with too many parameters"):
        KnownProcess(MirrorSensor(), shows="exact_belief")


@pytest.mark.parametrize("task", ["mountain_hike", "tiger"])
def test_who_is_shown_nothing_walks_the_same_way(task):
    plain, blind = find_environment(task)(), find_environment(task, shows="nothing")()

    seen, unseen = (play(environment, random_policy(environment, 3), 3) for environment in (plain, blind))

    for name in ("action", "reward"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(unseen, name))
    assert unseen.observation.shape == seen.observation.shape
    assert not unseen.observation.any()


def test_says_what_can_be_shown():
    with pytest.raises(ForbesError, match="shows is 'all', expected observation or exact_belief or nothing"):
        KnownProcess(MountainHike(), shows="all")
