"""Played episodes: what is stored depends on the seed and the number only, and what breaks is never stored."""

from functools import partial

import numpy as np
import pytest
from toy_environments import Echo, Pictures, Troubled

from forbes.data.episodes.collection import collect_episodes, describe_environment, play, random_policy
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.envs import EnvironmentProcess
from forbes.errors import ForbesError
from forbes.factors import to_index


def collect(path, environment, until, seed=0):
    with EpisodeWriter(path) as writer:
        return list(collect_episodes(environment, writer, random_policy, "random", until, seed))


def contents(path):
    return {file.name: file.read_bytes() for file in path.glob("*.npz")}


class Lamp(Echo):
    """Only here that the description says nothing of the process."""

    def describe(self):
        return {"task": "Lamp"}


def test_an_episode_has_what_each_step_said():
    episode = play(Echo(4, ends=True), lambda seen: np.array([(seen[1] + 1) / 8], np.float32), seed=5)

    assert episode.observation.tolist() == [[5, 0], [0.125, 1], [0.25, 2], [0.375, 3], [0.5, 4]]
    assert episode.action.ravel().tolist() == episode.reward.tolist() == [0, 0.125, 0.25, 0.375, 0.5]
    assert episode.terminated
    assert episode.frames == 12
    assert not play(Echo(4), random_policy(Echo(), 0), seed=5).terminated


def test_two_halves_are_the_whole(tmp_path):
    collect(tmp_path / "whole", Lamp(), 6)
    collect(tmp_path / "halves", Lamp(), 2)
    collect(tmp_path / "halves", Lamp(), 6)
    collect(tmp_path / "other", Lamp(), 6, seed=1)

    assert contents(tmp_path / "whole") == contents(tmp_path / "halves")
    assert contents(tmp_path / "whole").keys() == contents(tmp_path / "other").keys()
    assert contents(tmp_path / "whole") != contents(tmp_path / "other")


def test_a_broken_episode_is_played_again_and_leaves_no_trace(tmp_path, capsys):
    collect(tmp_path / "undisturbed", Echo(), 2)
    make = partial(Troubled, "raises", tmp_path / "ledger", times=2)
    with EnvironmentProcess(make) as environment:
        collect(tmp_path / "disturbed", environment, 2)

    ours, theirs = (EpisodeStore(tmp_path / name) for name in ("disturbed", "undisturbed"))
    for number in (0, 1):
        for mine, other in zip(ours.episode(number), theirs.episode(number), strict=True):
            np.testing.assert_array_equal(mine, other)
        assert ours.records[number].seed == theirs.records[number].seed
    assert capsys.readouterr().err.count("episode 0 is dropped and replayed") == 2


def test_three_failures_end_the_collection_and_lose_nothing(tmp_path):
    store = tmp_path / "store"
    collect(store, Echo(), 2)
    make = partial(Troubled, "rewards_nan", tmp_path / "ledger", times=3)
    with (
        EnvironmentProcess(make) as environment,
        pytest.raises(ForbesError, match=r"the reward is nan.*; episode 2 failed 3 times.*Fix the environment$"),
    ):
        collect(store, environment, 4)

    assert list(EpisodeStore(store).records) == [0, 1]
    assert len(contents(store)) == 2


@pytest.mark.parametrize("action", [np.array([np.nan], np.float32), np.zeros(2, np.float32)])
def test_a_policy_that_gives_no_action_is_told(action):
    with pytest.raises(ForbesError, match=r"Echo: the policy's action at step 0 is .*, expected 1 finite numbers"):
        play(Echo(), lambda _: action, seed=0)


def test_the_random_policy_draws_every_action_alike():
    echo, pictures = Echo(), Pictures()
    pictures.discrete = True
    policy, chooser = random_policy(echo, 0), random_policy(pictures, 0)

    values = np.array([policy(None)[0] for _ in range(2000)])
    chosen = np.array([chooser(None) for _ in range(2000)])

    assert abs(values.mean()) < 4 / np.sqrt(3 * 2000)  # uniform in [-1, 1]: variance 1/3
    assert abs(values.var() - 1 / 3) < 4 * np.sqrt(4 / 45 / 2000)
    assert (chosen.sum(1) == 1).all()
    assert abs(chosen.mean(0) - 0.5).max() < 4 * 0.5 / np.sqrt(2000)


def test_the_random_policy_makes_every_choice_by_itself():
    """All six pairs of choices are drawn alike, within 5 standard errors of 1/6."""
    echo = Echo()
    echo.action_dim, echo.discrete = 5, (3, 2)
    policy = random_policy(echo, 0)

    drawn = to_index(np.array([policy(None) for _ in range(3000)]), (3, 2)) @ [2, 1]  # (N,), 0 to 5

    share = np.bincount(drawn, minlength=6) / 3000
    assert abs(share - 1 / 6).max() < 5 * np.sqrt(5 / 36 / 3000)


def test_one_choice_is_drawn_by_the_same_random_numbers_as_ever():
    pictures = Pictures()
    pictures.discrete = True
    chooser, random = random_policy(pictures, 7), np.random.default_rng(7)

    for _ in range(20):
        np.testing.assert_array_equal(chooser(None), np.eye(2, dtype=np.float32)[random.integers(2)])


def test_the_record_says_what_the_episodes_are_of():
    said = describe_environment(Pictures())

    assert said == {
        "task": "Pictures",
        "observation_shape": [3, 8, 8],
        "action_dim": 2,
        "discrete": False,
        "action_repeat": 1,
    }
