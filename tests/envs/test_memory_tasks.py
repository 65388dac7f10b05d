"""POPGym and MiniGrid by name: extras whose packages are imported because a task names them."""

import numpy as np
import pytest

from forbes.data.episodes.collection import play, random_policy
from forbes.envs import find_environment
from forbes.envs.base import check_step
from forbes.envs.tasks import _PACKAGES
from forbes.errors import ForbesError

MEMORY, REPEAT = "gymnasium:minigrid:MiniGrid-MemoryS7-v0", "gymnasium:popgym:popgym-RepeatPreviousEasy-v0"


@pytest.mark.parametrize(
    ("task", "options", "shape"),
    [
        (MEMORY, {"part": "image"}, (3, 7, 7)),
        (REPEAT, {}, (4,)),
        (MEMORY, {"part": "image", "flicker": 0.5}, (3, 7, 7)),
    ],
)
def test_a_seed_is_an_episode(task, options, shape):
    pytest.importorskip(task.split(":")[1])
    environment = find_environment(task, **options)()

    first, other, again = (play(environment, random_policy(environment, 3), seed) for seed in (1, 2, 1))

    assert first.observation.shape[1:] == shape
    np.testing.assert_array_equal(first.observation, again.observation)
    np.testing.assert_array_equal(first.reward, again.reward)
    assert not np.array_equal(first.observation[:20], other.observation[:20])


def test_repeat_previous_pays_for_what_was_shown_before():
    """The reward is that of a player who remembers, if it is shown what comes, and less if it acts on the present."""
    pytest.importorskip("popgym")
    environment = find_environment(REPEAT)()

    def returns(lag):
        """Repeat what was shown `lag` steps ago."""
        shown = []

        def policy(observation):
            shown.append(observation)
            return shown[max(0, len(shown) - 1 - lag)]

        return np.mean([play(environment, policy, seed).total_reward for seed in range(5)])

    earned = {lag: returns(lag) for lag in range(6)}
    assert max(earned, key=earned.get) == 3  # the fourth last, with the present one
    assert earned[3] == pytest.approx(1.0, abs=0.05)
    assert earned[0] < 0


def test_the_integers_of_minigrid_are_at_most_ten():
    pytest.importorskip("minigrid")
    environment = find_environment(MEMORY, part="image")()

    assert max(play(environment, random_policy(environment, 0), seed).observation.max() for seed in range(3)) <= 10


def test_a_seed_is_a_maze():
    pytest.importorskip("memory_maze")
    environment = find_environment("memory_maze_9x9")()
    one = np.eye(6, dtype=np.float32)[1]

    first, other, again = ([environment.reset(seed), *(environment.step(one) for _ in range(5))] for seed in (1, 2, 1))

    pictures = [np.stack([step.observation for step in steps]) for steps in (first, other, again)]
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert not np.array_equal(pictures[0], pictures[1])
    check_step(first[-1], (3, 64, 64))


def test_a_missing_extra_is_one_sentence(monkeypatch):
    monkeypatch.setattr("forbes.envs.tasks.find_spec", lambda name: None)

    for package in _PACKAGES:
        with pytest.raises(ForbesError, match=rf"{package} is not installed. pip install 'forbes\[{package}\]'"):
            find_environment(f"gymnasium:{package}:Name-v0")
