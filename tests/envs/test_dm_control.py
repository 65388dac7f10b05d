"""The DeepMind Control Suite: the same seed is the same episode, and a step is what the suite itself says."""

from functools import partial
from itertools import chain

import numpy as np
import pytest
from dm_control import _render, suite
from toy_environments import EvaluatedRun

from forbes.envs import DeepMindControl, Environment, EnvironmentProcess, find_environment
from forbes.errors import ForbesError


def actions(environment, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, environment.action_dim)).astype(np.float32)


def play(environment, seed, steps):
    """The steps of an episode's beginning, under the same actions each time."""
    return [environment.reset(seed), *map(environment.step, actions(environment, steps))]


def same(one, other):
    """Whether two episodes are equal bit for bit."""
    pairs = zip(one, other, strict=True)
    return all(np.array_equal(a.observation, b.observation) and a[1:] == b[1:] for a, b in pairs)


@pytest.fixture(scope="module", params=suite.BENCHMARKING, ids="_".join)
def environment(request):
    """Each task of the suite, built once."""
    return DeepMindControl("_".join(request.param), pixels=False)


def test_a_seed_is_an_episode_whatever_was_played_before(environment):
    first = play(environment, seed=5, steps=4)
    other = play(environment, seed=6, steps=4)
    again = play(environment, seed=5, steps=4)

    assert same(first, again)
    assert not same(first, other)
    assert all(np.isfinite(step.observation).all() and np.isfinite(step.reward) for step in first)
    assert first[0].observation.shape == environment.observation_shape


def test_every_task_names_all_its_dimensions(environment):
    parts = environment.named_parts()
    velocities = parts.pop("velocities")

    (size,) = environment.observation_shape
    assert [*chain(*parts.values())] == list(range(size))
    assert 0 < len(velocities) < size


@pytest.mark.parametrize("action_repeat", [1, 3])
def test_a_step_repeats_a_suite_step_with_a_rescaled_action(action_repeat):
    ours = DeepMindControl("cartpole_balance", pixels=False, action_repeat=action_repeat)
    theirs = suite.load("cartpole", "balance", task_kwargs={"random": 4})
    theirs.reset()
    spec = theirs.action_spec()

    ours.reset(4)
    for action in actions(ours, 5):
        step, reward = ours.step(action), 0.0
        for _ in range(action_repeat):
            time_step = theirs.step(spec.minimum + (action + 1.0) / 2 * (spec.maximum - spec.minimum))
            reward += time_step.reward
        flat = np.concatenate([np.ravel(value) for value in time_step.observation.values()])
        np.testing.assert_array_equal(step.observation, flat.astype(np.float32))
        assert step.reward == reward > 0.5 * action_repeat
        assert step.frames == action_repeat


@pytest.mark.parametrize(("action_repeat", "steps"), [(8, 125), (7, 143)])
def test_the_time_limit_cuts_and_frames_are_counted(action_repeat, steps):
    environment = DeepMindControl("pendulum_swingup", pixels=False, action_repeat=action_repeat)
    environment.reset(0)
    taken = []
    while not taken or not (taken[-1].terminated or taken[-1].truncated):
        taken.append(environment.step(np.zeros(1, np.float32)))

    assert len(taken) == steps
    assert sum(step.frames for step in taken) == 1000
    assert (taken[-1].terminated, taken[-1].truncated) == (False, True)


@pytest.mark.parametrize("task", ["cartpole_swingup", "walker_walk"])
def test_pixels_are_the_same_for_the_same_seed(task, backend):
    with EnvironmentProcess(find_environment(task, backend=backend)) as environment:
        first = play(environment, seed=5, steps=3)
        other = play(environment, seed=6, steps=3)
        again = play(environment, seed=5, steps=3)
        made_by = environment.describe()["made_by"]

    assert environment.observation_shape == (3, 64, 64)
    assert all(step.observation.shape == (3, 64, 64) and step.observation.dtype == np.uint8 for step in first)
    assert same(first, again)
    assert not np.array_equal(first[0].observation, other[0].observation)
    assert not np.array_equal(first[0].observation, first[-1].observation)
    assert made_by["backend"] == backend
    assert made_by["gl_renderer"]


def test_fast_pixels_are_other_pixels_and_say_so(backend):
    frames, records = [], []
    for fast in (False, True):
        make = find_environment("walker_walk", backend=backend, fast=fast, size=32)
        with EnvironmentProcess(make) as environment:
            frames.append(environment.reset(0).observation)
            records.append(environment.describe()["fast"])

    assert records == [False, True]
    difference = np.abs(frames[0].astype(int) - frames[1])
    assert 0 < difference.mean() < 8  # of 255: shadows and edges
    assert frames[0].shape == (3, 32, 32)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_pole_thinner_than_a_pixel_is_in_a_fast_frame(backend, seed):
    """One sample a pixel misses it: these rows are then all sky, whose red differs by 4."""
    with EnvironmentProcess(find_environment("cartpole_balance", backend=backend, fast=True, size=28)) as environment:
        red = environment.reset(seed).observation[0, 6:12].astype(int)  # the rows of an upright pole

    assert (np.ptp(red, axis=1) > 15).all()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("cartpole_swingp",), "cartpole_swingp: no such task. Did you mean cartpole_swingup"),
        (("walker_wlak",), "Did you mean walker_walk"),
        (("qqq",), "qqq: no such task. `forbes data collect --help` lists the tasks"),
        (("cartpole_swingup", False, 0), "cartpole_swingup: action_repeat is 0, expected at least 1"),
        (
            ("lqr_lqr_2_1",),
            "lqr_lqr_2_1: its actions are unbounded, so [-1, 1] cannot be scaled to them.",
        ),
    ],
)
def test_what_does_not_exist_is_one_sentence(arguments, sentence):
    with pytest.raises(ForbesError) as error:
        DeepMindControl(*arguments, **({"pixels": False} if len(arguments) == 1 else {}))
    assert sentence in str(error.value)


class Painted:
    """A suite's task, as far as its frames go: all of one colour but for what is set in them."""

    def __init__(self, *pixels):
        self.physics = self
        self.frame = np.full((64, 64, 3), (0, 0, 200), np.uint8)
        for pixel in pixels:
            self.frame[pixel] = 255

    def render(self, height, width, camera_id):
        return self.frame


def test_only_a_frame_of_a_single_colour_is_an_error():
    environment = DeepMindControl("cartpole_balance", pixels=False)
    environment.pixels = True

    environment._environment = Painted((63, 63))
    assert environment._observe(None)[:, 63, 63].tolist() == [255, 255, 255]
    environment._environment = Painted()
    with pytest.raises(RuntimeError, match="renders a frame of one colour"):
        environment._observe(None)


def test_the_buffer_is_as_large_as_the_frame(backend):
    """MuJoCo's own, of 640 x 480, costs 20 % more."""
    make = partial(EvaluatedRun, "cartpole_balance", backend=backend, size=48)
    with EnvironmentProcess(make) as environment:
        assert environment.describe()["buffer"] == [48, 48]


def test_a_camera_that_does_not_exist_is_one_sentence(backend):
    with pytest.raises(ForbesError, match=r"^cartpole_swingup: has no camera 9, expected 0 to \d\. Choose one"):
        EnvironmentProcess(find_environment("cartpole_swingup", backend=backend, camera=9))


def test_importing_the_suite_for_another_backend_is_refused():
    other = "osmesa" if _render.BACKEND == "egl" else "egl"  # this very process has imported it for one of them

    with pytest.raises(
        ForbesError, match=rf"has imported dm_control with MUJOCO_GL=.*, expected {other}.*EnvironmentProcess"
    ):
        DeepMindControl("cartpole_swingup", backend=other)


def test_image_and_proprioception_are_those_of_each_alone(backend):
    options = {"pixels": {}, "vector": {"pixels": False}, "both": {"proprio": True}}
    seen = {}
    for name, given in options.items():
        extra = given if name == "vector" else given | {"backend": backend, "size": 32}
        with EnvironmentProcess(find_environment("cartpole_swingup", **extra)) as environment:
            first = environment.reset(3)
            seen[name] = [first.observation, environment.step(np.ones(1, np.float32)).observation]
            shape, described = environment.observation_shape, environment.describe()

    assert shape == {"camera": (3, 32, 32), "proprio": (5,)}
    assert described["proprio"] is True
    for alone, vector, both in zip(seen["pixels"], seen["vector"], seen["both"], strict=True):
        np.testing.assert_array_equal(both["camera"], alone)
        np.testing.assert_array_equal(both["proprio"], vector)


def test_proprioception_needs_pixels():
    with pytest.raises(ForbesError, match="proprio adds the measurements to images, expected pixels"):
        DeepMindControl("cartpole_swingup", pixels=False, proprio=True)


@pytest.mark.parametrize("option", [{"camera": 1}, {"size": 64}, {"fast": True}], ids=str)
def test_options_of_images_need_pixels(option):
    with pytest.raises(ForbesError, match=f"{next(iter(option))} is for images, expected pixels"):
        DeepMindControl("cartpole_swingup", pixels=False, **option)


def test_a_class_of_a_similar_name_does_not_hide_a_task():
    class CartpoleSwingup(Environment):
        """Of a user, in a module that was imported."""

    assert find_environment("cartpole_swingup", pixels=False)().task == "cartpole_swingup"
