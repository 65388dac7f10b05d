"""Environments whose observations have several parts, and views of them."""

import numpy as np
import pytest
from toy_environments import Robot

from forbes.data.episodes.collection import play, random_policy
from forbes.envs import BrokenEnvironmentError, EnvironmentProcess, Step
from forbes.envs.base import check_environment, check_step
from forbes.envs.views import look_through
from forbes.errors import ForbesError
from forbes.shapes import shape_of


def seen(views=None, seed=3):
    environment = look_through(Robot, views or {})
    return play(environment, random_policy(environment, 0), seed).observation


class Forgetful(Robot):
    """Leaves out a part in the second step."""

    def step(self, action):
        step = super().step(action)
        return step._replace(observation={"camera": step.observation["camera"]}) if self.time == 2 else step


def test_a_process_plays_the_same_episode():
    with EnvironmentProcess(Robot) as environment:
        assert environment.observation_shape == {"camera": (1, 6, 6), "joint": (2,)}
        there = play(environment, random_policy(environment, 0), 3)

    for part, expected in seen().items():
        np.testing.assert_array_equal(there.observation[part], expected)


def test_a_part_that_is_missing_breaks_the_episode():
    with EnvironmentProcess(Forgetful) as environment:
        environment.reset(0)
        environment.step(np.zeros(1, np.float32))
        with pytest.raises(BrokenEnvironmentError, match=r"has \['camera'\], expected the parts \['camera', 'joint'\]"):
            environment.step(np.zeros(1, np.float32))


@pytest.mark.parametrize(
    ("joint", "sentence"),
    [
        (np.zeros(2), "the observation's joint is float64"),
        (np.zeros(3, np.float32), "the observation's joint is float32 .3,., expected float32 .2,."),
        (np.full(2, np.nan, np.float32), "the observation's joint is not finite"),
        ([0.0, 0.0], "the observation's joint is a list"),
    ],
    ids=["dtype", "shape", "nan", "list"],
)
def test_a_part_that_is_wrong_is_named(joint, sentence):
    camera = np.zeros((1, 6, 6), np.uint8)

    with pytest.raises(ValueError, match=sentence):
        check_step(Step({"camera": camera, "joint": joint}), shape_of(Robot().observation_shape))
    with pytest.raises(ValueError, match="the observation has no parts"):
        check_step(Step(camera), shape_of(Robot().observation_shape))


@pytest.mark.parametrize("shape", [{}, {"a b": (3,)}, {"camera": (6, 6)}, {"camera": ()}, {3: (3,)}], ids=str)
def test_invalid_shapes_of_parts_are_refused(shape):
    environment = Robot()
    environment.observation_shape = shape

    with pytest.raises(ForbesError, match="a dict of these by part"):
        check_environment(environment)


def test_views_of_all_parts_blank_and_delay_them_together():
    plain, late, dark = seen(), seen({"delay": 2}), seen({"blank_until": 3})

    for part, values in plain.items():
        np.testing.assert_array_equal(late[part][2:], values[:-2])
        np.testing.assert_array_equal(dark[part][3:], values[3:])
        assert not late[part][:2].any()
        assert not dark[part][:3].any()


def test_a_view_of_one_part_leaves_the_others_alone():
    plain, hidden, noisy = seen(), seen({"hide": {"joint": "velocities"}}), seen({"noise": {"joint": 0.5}})

    np.testing.assert_array_equal(hidden["joint"], plain["joint"][:, 1:])
    np.testing.assert_array_equal(noisy["camera"], plain["camera"])
    assert (noisy["joint"] != plain["joint"]).all()


def test_views_of_several_parts_have_their_own_randomness():
    """The same view of two parts: blank in different steps; each a function of the seed."""
    both = {"flicker": {"camera": 0.5, "joint": 0.5}}
    plain = [seen(seed=seed) for seed in range(20)]
    blank = {part: [] for part in ("camera", "joint")}
    for seed, there in enumerate(plain):
        shown = seen(both, seed=seed)
        for part in blank:
            blank[part].append([not image.any() for image in shown[part][1:]])
            assert all(image.any() for image in there[part][1:])

    assert blank["camera"] != blank["joint"]
    np.testing.assert_array_equal(seen(both, 7)["camera"], seen(both, 7)["camera"])
    shares = [np.mean(blank[part]) for part in blank]  # of 180 steps
    assert all(abs(share - 0.5) < 5 * (0.25 / 180) ** 0.5 for share in shares)


def test_views_of_parts_are_recorded():
    views = {"hide": {"joint": [0]}, "noise": {"camera": 0.1}, "delay": 1}
    environment = look_through(Robot, views)

    recorded = [{"hide": {"joint": [0]}}, {"noise": {"camera": 0.1}}, {"delay": 1}]
    assert environment.describe()["views"] == recorded
    assert environment.observation_shape == {"camera": (1, 6, 6), "joint": (1,)}
    assert environment.named_parts() == {"clock": [0]}


@pytest.mark.parametrize(
    ("views", "sentence"),
    [
        ({"hide": "velocities"}, "hide is 'velocities', expected its value for one of the parts camera, joint"),
        ({"occlude": [0, 0, 1, 1]}, "occlude is .*, expected its value for one of the parts camera, joint"),
        ({"hide": {"camera": [0]}}, "hide is .0., expected vectors to hide parts of, not images"),
        ({"noise": {"sound": 0.1}}, "Robot: a view names the part sound, expected one of camera, joint"),
    ],
    ids=["hide", "occlude", "kind", "unknown"],
)
def test_a_view_that_does_not_fit_the_parts_is_refused(views, sentence):
    with pytest.raises(ForbesError, match=sentence):
        look_through(Robot, views)
