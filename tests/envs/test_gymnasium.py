"""Environments of Gymnasium: an action and a step are what Gymnasium itself makes of them."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from forbes.envs import Gymnasium  # noqa: E402
from forbes.errors import ForbesError  # noqa: E402


class Camera(gymnasium.Env):
    """Draws the left half of a picture in the colour of the last action."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012
    observation_space = gymnasium.spaces.Discrete(3)
    action_space = gymnasium.spaces.Discrete(3, start=1)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.colour = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.colour = 0
        return 0, {}

    def step(self, action):
        self.colour = int(action)
        return self.colour - 1, 0.5, self.colour == 3, False, {}

    def render(self):
        picture = np.zeros((20, 30, 3), np.uint8)
        picture[:, :15] = 60 * self.colour
        return picture


class Levers(Camera):
    action_space = gymnasium.spaces.MultiDiscrete([2, 2])


def needs_another_package(render_mode=None):
    raise gymnasium.error.DependencyNotInstalled('Box2D is not installed, you can install it with "pip install Box2D"')


@pytest.fixture(scope="module", autouse=True)
def registered():
    gymnasium.register("forbes/Needy-v0", entry_point=needs_another_package)
    gymnasium.register("forbes/Camera-v0", entry_point=Camera)
    gymnasium.register("forbes/Levers-v0", entry_point=Levers)
    yield
    for name in ("Camera", "Levers", "Needy"):
        del gymnasium.registry[f"forbes/{name}-v0"]


def test_a_step_is_gymnasiums_own():
    ours, theirs = Gymnasium("Pendulum-v1", action_repeat=2), gymnasium.make("Pendulum-v1")
    seen, _ = theirs.reset(seed=3)

    np.testing.assert_array_equal(ours.reset(3).observation, seen)
    for action in np.linspace(-1, 1, 5, dtype=np.float32):
        step, rewards = ours.step(action[None]), 0.0
        for _ in range(2):
            seen, reward, *_ = theirs.step(2 * action[None])  # its bounds
            rewards += reward
        np.testing.assert_array_equal(step.observation, seen)
        assert step.reward == rewards
        assert step.frames == 2


def test_a_seed_is_an_episode_and_the_time_limit_cuts_it():
    environment = Gymnasium("Pendulum-v1")
    episodes = []
    for seed in (3, 4, 3):
        steps = [environment.reset(seed)]
        while not (steps[-1].terminated or steps[-1].truncated):
            steps.append(environment.step(np.array([0.3], np.float32)))
        episodes.append(steps)

    values = [np.stack([step.observation for step in steps]) for steps in episodes]
    np.testing.assert_array_equal(values[0], values[2])
    assert not np.array_equal(values[0], values[1])
    assert len(episodes[0]) == 201
    assert (episodes[0][-1].terminated, episodes[0][-1].truncated) == (False, True)


def test_one_of_several_actions_is_one_hot_and_a_number_observed_is_so_too():
    environment = Gymnasium("forbes/Camera-v0")
    assert environment.discrete
    assert (environment.action_dim, environment.observation_shape) == (3, (3,))

    environment.reset(0)
    step = environment.step(np.array([0, 0, 1], np.float32))

    assert step.observation.tolist() == [0, 0, 1]  # the action was 3, the first being 1
    assert (step.terminated, step.truncated) == (True, False)


def test_pixels_are_what_it_draws_made_smaller():
    environment = Gymnasium("forbes/Camera-v0", pixels=True, size=10)
    environment.reset(0)

    frame = environment.step(np.array([0, 1, 0], np.float32)).observation

    assert frame.shape == (3, 10, 10)
    assert (frame[:, :, :5] == 120).all()
    assert not frame[:, :, 5:].any()


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        ("Pendulm-v1", "Pendulm-v1: gymnasium has no such environment. Did you mean Pendulum-v1"),
        ("no_such_package:Thing-v0", "no_such_package:Thing-v0: gymnasium has no such environment"),
        ("forbes/Needy-v0", "forbes/Needy-v0: Box2D is not installed"),
        ("forbes/Levers-v0", "its actions are a MultiDiscrete, expected a Box or a Discrete. Wrap it"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(task, sentence):
    with pytest.raises(ForbesError) as error:
        Gymnasium(task)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)
