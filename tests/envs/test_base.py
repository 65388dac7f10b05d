"""What all environments share: held actions add up their rewards, and actions are in the units of their bounds."""

import numpy as np
import pytest

from forbes.envs.base import Environment, Step, check_environment, check_step, repeat, scale_action
from forbes.errors import ForbesError

SEEN = np.zeros(2, np.float32)


def frames(*rewards, terminated=False):
    """A function that gives a frame each time it is called; the last may end the episode."""
    steps = [Step(SEEN + time, reward) for time, reward in enumerate(rewards)]
    steps[-1] = steps[-1]._replace(terminated=terminated)
    return iter(steps).__next__


def test_repeated_steps_add_up_and_show_the_last_observation():
    step = repeat(frames(1.0, 2.0, 4.0, 8.0), 3)

    assert (step.reward, step.frames, step.observation.tolist()) == (7.0, 3, [2.0, 2.0])
    assert not step.terminated


def test_the_end_of_an_episode_is_not_passed():
    step = repeat(frames(1.0, 2.0, terminated=True), 5)

    assert (step.reward, step.frames, step.terminated) == (3.0, 2, True)


def test_an_action_fills_bounds_and_is_unscaled_without_them():
    low, high = np.array([0, -2, -np.inf, 1, -np.inf]), np.array([4, 2, np.inf, np.inf, -5])

    for action, expected in ((-1, [0, -2, -1, 1, -7]), (0, [2, 0, 0, 2, -6]), (1, [4, 2, 1, 3, -5])):
        assert scale_action(np.full(5, action, np.float32), low, high).tolist() == expected


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (Step(SEEN, reward=float("inf")), "the reward is inf, expected a finite number"),
        (Step(SEEN + np.float32(np.inf)), "the observation is not finite"),
        (Step(np.zeros((3, 8, 8), np.float32)), r"the observation is float32 \(3, 8, 8\), expected float32 \(2,\)"),
    ],
)
def test_what_is_no_step_is_said(step, sentence):
    check_step(Step(SEEN, 1.0), (2,))
    check_step(Step(np.zeros((3, 8, 8), np.uint8)), (3, 8, 8))
    with pytest.raises(ValueError, match=sentence):
        check_step(step, SEEN.shape)


class Sound(Environment):
    observation_shape, action_dim = (2,), 1

    def reset(self, seed):
        return Step(np.zeros(2, np.float32))

    def step(self, action):
        return Step(np.zeros(2, np.float32))


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        (
            "observation_shape",
            None,
            "observation_shape is None, expected (C, H, W), (O,) or a dict of these by part. Set it in the class",
        ),
        ("observation_shape", (8, 8), "observation_shape is (8, 8), expected"),
        ("observation_shape", 4, "observation_shape is 4, expected"),
        ("action_dim", 0, "action_dim is 0, expected an integer above 0"),
        ("action_dim", 1.5, "action_dim is 1.5, expected"),
        ("action_repeat", None, "action_repeat is None, expected"),
        ("discrete", 1, "discrete is 1, expected true or false"),
        ("describe", dict, "describe() returns {}, expected a task"),
    ],
)
def test_what_an_environment_must_say_is_checked(name, value, sentence):
    environment = Sound()
    check_environment(environment)
    setattr(environment, name, value)

    with pytest.raises(ForbesError) as error:
        check_environment(environment)
    assert str(error.value).startswith(f"Sound: {sentence}")


def test_what_is_no_step_is_named():
    with pytest.raises(ValueError, match="it returns a tuple, expected a Step"):
        check_step((SEEN, 0.0), SEEN.shape)
