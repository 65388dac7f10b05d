"""Environments of Gymnasium: an action and a step are what Gymnasium itself makes of them."""

import itertools
import sys
from importlib.metadata import EntryPoint

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

import toy_gymnasium  # noqa: E402
from gymnasium.spaces import (  # noqa: E402
    Box,
    Dict,
    Discrete,
    Graph,
    MultiBinary,
    MultiDiscrete,
    OneOf,
    Sequence,
    Text,
    Tuple,
)

from forbes.commands.cli import main  # noqa: E402
from forbes.data import Experience  # noqa: E402
from forbes.data.episodes.store import EpisodeStore  # noqa: E402
from forbes.envs import Gymnasium, find_environment  # noqa: E402
from forbes.envs.base import check_environment, check_step  # noqa: E402
from forbes.errors import ForbesError  # noqa: E402
from forbes.factors import factor_sizes, to_one_hot  # noqa: E402
from forbes.shapes import shape_of  # noqa: E402


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
    action_space = gymnasium.spaces.Tuple([Discrete(2), Discrete(2)])


def needs_another_package(render_mode=None):
    raise gymnasium.error.DependencyNotInstalled('Box2D is not installed, you can install it with "pip install Box2D"')


@pytest.fixture(scope="module", autouse=True)
def registered():
    gymnasium.register("forbes/Needy-v0", entry_point=needs_another_package)
    gymnasium.register("forbes/Bare-v0", entry_point="no_such_module:Bare")
    gymnasium.register("forbes/Camera-v0", entry_point=Camera)
    gymnasium.register("forbes/Levers-v0", entry_point=Levers)
    gymnasium.register("forbes/Given-v0", entry_point=toy_gymnasium.Given, disable_env_checker=True)
    yield
    for name in ("Camera", "Given", "Levers", "Needy"):
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


def test_a_discrete_action_and_observation_are_one_hot():
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


@pytest.mark.parametrize("pixels", [False, True])
def test_an_image_has_a_pixel_at_least(pixels):
    with pytest.raises(ForbesError, match="size is 0, expected at least 1"):
        Gymnasium("forbes/Camera-v0", pixels=pixels, size=0)


def test_a_size_without_an_image_is_refused():
    with pytest.raises(ForbesError, match=r"CartPole-v1: size is for images, and it observes none\. Set pixels"):
        Gymnasium("CartPole-v1", size=64)


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        ("forbes/Bare-v0", "forbes/Bare-v0: needs the module no_such_module, which is not installed. Install it"),
        ("Pendulm-v1", "Pendulm-v1: gymnasium has no such environment. Did you mean Pendulum-v1"),
        ("toy_gymnasium:Toy-Room-v0", "gymnasium has no such environment. Did you mean Toy-Rooms-v0"),
        ("no_such_package:Thing-v0", "no_such_package:Thing-v0: gymnasium has no such environment"),
        ("forbes/Needy-v0", "forbes/Needy-v0: Box2D is not installed"),
        ("forbes/Levers-v0", "its actions are a Tuple, expected a Box, Discrete, MultiDiscrete or MultiBinary. Wrap"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(task, sentence):
    with pytest.raises(ForbesError) as error:
        Gymnasium(task)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def environment_of(monkeypatch, space=None, value=0, actions=None, **options):
    """The environment that shows a value of a space, or takes an action of one."""
    given = {"space": space or Discrete(2), "value": value, "action_space": actions}
    monkeypatch.setattr(gymnasium.registry["forbes/Given-v0"], "kwargs", given)
    return Gymnasium("forbes/Given-v0", **options)


ONE_SIDED = {
    "below": Box(0.0, np.inf, (2,)),
    "above": Box(-np.inf, -3.0, (2,)),
    "both": Box(np.array([-1.0, 2.0], np.float32), np.array([7.0, np.inf], np.float32)),
    "none": Box(-np.inf, np.inf, (2,)),
    "integers below": Box(5, np.inf, (2,), np.int64),
    "integers": Box(-3, 3, (2,), np.int8),
}


@pytest.mark.parametrize("bounds", ONE_SIDED)
def test_every_action_lies_within_its_box(bounds, monkeypatch):
    environment = environment_of(monkeypatch, actions=ONE_SIDED[bounds])
    for action in np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32):
        environment.step(action)  # the toy refuses what its space does not contain
    for corner in (-1, 1):
        environment.step(np.full(2, corner, np.float32))


@pytest.mark.parametrize(("low", "high"), [(0, 3), (-2, 1), (-2, 2), (4, 4)])
def test_whole_numbers_of_a_box_are_drawn_alike(low, high, monkeypatch):
    """Each of n numbers is what a share 1/n of [-1, 1] means: on an even grid, the counts are equal."""
    environment = environment_of(monkeypatch, actions=Box(low, high, (1,), np.int32))
    numbers = np.arange(low, high + 1)
    grid = (np.arange(60 * len(numbers)) + 0.5) / (30 * len(numbers)) - 1

    taken = []
    for action in grid:
        environment.step(np.array([action], np.float32))
        taken.append(environment._environment.unwrapped.taken.item())

    found, counts = np.unique(taken, return_counts=True)
    np.testing.assert_array_equal(found, numbers)
    np.testing.assert_array_equal(counts, 60)
    environment.step(np.ones(1, np.float32))
    assert environment._environment.unwrapped.taken == high


CHOICES = {
    "one": (Discrete(3, start=5), True),
    "several": (MultiDiscrete([3, 2]), (3, 2)),
    "from others than 0": (MultiDiscrete([3, 2], start=[5, -1]), (3, 2)),
    "a table": (MultiDiscrete([[2, 3], [1, 4]]), (2, 3, 1, 4)),
    "several of one": (MultiDiscrete([4]), True),
    "buttons": (MultiBinary(3), (2, 2, 2)),
    "a pad of buttons": (MultiBinary([2, 2]), (2, 2, 2, 2)),
    "a button": (MultiBinary(1), True),
}


@pytest.mark.parametrize("kind", CHOICES)
def test_every_choice_of_a_space_is_one_action(kind, monkeypatch):
    """All of its members are reached, and none twice; the toy refuses what its space does not contain."""
    space, discrete = CHOICES[kind]
    environment = environment_of(monkeypatch, actions=space)
    check_environment(environment)
    sizes = factor_sizes(environment.discrete, environment.action_dim)

    taken = []
    for index in itertools.product(*map(range, sizes)):
        environment.step(to_one_hot(np.array(index), sizes))
        taken.append(environment._environment.unwrapped.taken)
        last = np.ravel(taken[-1]) - np.ravel(getattr(space, "start", 0))
        np.testing.assert_array_equal(last, index)

    assert environment.discrete == discrete
    assert taken[0].dtype == space.dtype
    assert len(np.unique(np.stack(taken).reshape(len(taken), -1), axis=0)) == len(taken) == np.prod(sizes)


@pytest.mark.parametrize("shape", [(84, 84), (84, 84, 1), (20, 30, 3), (4, 84, 84)])
def test_image_spaces_are_images_with_channels_first(shape, monkeypatch):
    value = np.random.default_rng(0).integers(256, size=shape, dtype=np.uint8)
    first = {(84, 84): value[None], (4, 84, 84): value}.get(shape, np.moveaxis(value, -1, 0))

    whole = environment_of(monkeypatch, Box(0, 255, shape, np.uint8), value)
    small = environment_of(monkeypatch, Box(0, 255, shape, np.uint8), value, size=10)

    np.testing.assert_array_equal(whole.reset(0).observation, first)
    check_step(whole.reset(0), whole.observation_shape)
    assert small.observation_shape == (len(first), 10, 10)
    assert abs(small.reset(0).observation.mean() - value.mean()) < 2


def test_a_smaller_image_is_the_mean_of_what_each_pixel_covers(monkeypatch):
    value = np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 4  # steps of 4: means are whole numbers

    environment = environment_of(monkeypatch, Box(0, 255, (4, 4, 3), np.uint8), value, size=2)

    expected = value.reshape(2, 2, 2, 2, 3).mean((1, 3)).transpose(2, 0, 1)
    np.testing.assert_array_equal(environment.reset(0).observation, expected)


def test_parts_are_concatenated_and_whole_numbers_are_scaled(monkeypatch):
    space = Tuple((Box(-9.0, 9.0, (2,)), Box(10, 20, (2,), np.int64), Dict(b=MultiDiscrete([2, 3]), a=Text(9))))
    value = (np.array([-8.0, 0.5], np.float32), np.array([10, 15]), {"a": "word", "b": np.array([1, 0])})

    seen = environment_of(monkeypatch, space, value).reset(0).observation

    assert seen.tolist() == [-8.0, 0.5, 0.0, 0.5, 0, 1, 1, 0, 0]
    assert seen.dtype == np.float32


def test_bytes_are_scaled_and_unbounded_numbers_are_not(monkeypatch):
    memory = np.array([0, 51, 255], np.uint8)
    assert environment_of(monkeypatch, Box(0, 255, (3,), np.uint8), memory).reset(0).observation.tolist() == [
        0,
        np.float32(0.2),
        1,
    ]
    count = np.array([7])
    assert environment_of(monkeypatch, Box(0, np.inf, (1,), np.int64), count).reset(0).observation.tolist() == [7]


def test_a_package_that_registers_as_minigrid_does_is_collected(tmp_path):
    folder = tmp_path / "rooms"
    collect = ["data", "collect", "--task", "gymnasium:toy_gymnasium:Toy-Rooms-v0", "--episodes", "2"]

    assert main([*collect, "-o", str(folder)]) == 0

    episode = EpisodeStore(folder).episode(1)
    assert {*episode.observation} == {"image", "direction"}  # text is left out
    np.testing.assert_array_equal(episode.observation["direction"], np.eye(4)[[2] * 5])
    np.testing.assert_array_equal(episode.observation["image"], np.full((5, 3, 7, 7), 51))


@pytest.mark.parametrize(
    ("options", "shape"),
    [
        ({}, {"direction": (4,), "image": (3, 7, 7)}),
        ({"parts": ["image", "direction"]}, {"direction": (4,), "image": (3, 7, 7)}),
        ({"parts": ["direction"]}, {"direction": (4,)}),
        ({"part": "direction"}, (4,)),
        ({"part": "image"}, (3, 7, 7)),
        ({"size": 14}, {"direction": (4,), "image": (3, 14, 14)}),
    ],
    ids=["all", "both", "one of several", "vector", "image", "resized"],
)
def test_entries_of_a_dict_are_parts_where_one_is_an_image(options, shape):
    environment = find_environment("gymnasium:toy_gymnasium:Toy-Rooms-v0", **options)()

    assert environment.observation_shape == shape
    check_environment(environment)
    check_step(environment.reset(0), shape_of(shape))


def test_a_dict_of_vectors_stays_one_vector_unless_parts_are_named(monkeypatch):
    space = Dict({"robot.arm": Box(-1, 1, (2,)), "goal": Box(-1, 1, (1,))})
    value = {"robot.arm": np.ones(2, np.float32), "goal": np.zeros(1, np.float32)}

    assert environment_of(monkeypatch, space, value).observation_shape == (3,)
    named = environment_of(monkeypatch, space, value, parts=["robot.arm", "goal"])
    assert named.observation_shape == {"robot_arm": (2,), "goal": (1,)}
    assert named.describe()["parts"] == ["robot.arm", "goal"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"parts": ["image", "sound"]}, "parts is 'sound', expected one of direction, image, mission"),
        ({"parts": []}, "parts is '', expected one of direction"),
        ({"part": "image", "parts": ["direction"]}, "part and parts are both set"),
        ({"parts": ["mission"]}, "its observations are text"),
    ],
    ids=["unknown", "none", "both", "text"],
)
def test_entries_that_cannot_be_parts_are_refused(options, sentence):
    with pytest.raises(ForbesError, match=sentence):
        find_environment("gymnasium:toy_gymnasium:Toy-Rooms-v0", **options)()


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A module that says when it is imported, and registers an environment."""
    mark = tmp_path / "executed"
    (tmp_path / "a_stranger.py").write_text(
        f"import gymnasium, pathlib\npathlib.Path({str(mark)!r}).touch()\n"
        "gymnasium.register('Stranger-v0', entry_point='toy_gymnasium:Rooms', max_episode_steps=4)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield mark
    sys.modules.pop("a_stranger", None)


@pytest.mark.parametrize("task", ["a_stranger:Stranger-v0", "a_stranger:more:Stranger-v0", "os.path2:Stranger-v0"])
def test_a_module_that_only_a_task_names_is_not_imported(stranger, tmp_path, capsys, task):
    collect = ["data", "collect", "--task", f"gymnasium:{task}", "--episodes", "1", "-o", str(tmp_path / "store")]

    with pytest.raises(ForbesError, match="is not a package that registers environments"):
        Experience(f"gymnasium:{task}")
    assert main(collect) == 2

    module = task.rpartition(":")[0]
    assert f"gymnasium:{task}: {module} is not a package that registers" in capsys.readouterr().err
    assert not stranger.exists()


def test_an_allowed_module_registers_its_environments(stranger, tmp_path):
    collect = ["data", "collect", "--task", "gymnasium:a_stranger:Stranger-v0", "--episodes", "1"]

    assert main(["--allow-module", "a_stranger", *collect, "-o", str(tmp_path / "store")]) == 0

    assert stranger.exists()
    assert len(EpisodeStore(tmp_path / "store").records) == 1


@pytest.mark.parametrize("module", ["minigrid", "minigrid.__init__", "minigrid.envs"])
def test_a_package_with_an_entry_point_needs_no_permission(monkeypatch, module):
    entry = EntryPoint("__root__", f"{module}:register_minigrid_envs", "gymnasium.envs")
    monkeypatch.setattr("forbes.envs.tasks.entry_points", lambda group: [entry])

    make = find_environment("gymnasium:minigrid:MiniGrid-Empty-5x5-v0")

    assert make.args == ("minigrid:MiniGrid-Empty-5x5-v0",)


def test_an_entry_of_a_dict_may_be_all_that_is_observed():
    environment = find_environment("gymnasium:toy_gymnasium:Toy-Rooms-v0", part="image", size=28)()

    assert environment.observation_shape == (3, 28, 28)
    assert (environment.reset(0).observation == 51).all()
    assert environment.describe()["part"] == "image"


def test_the_help_names_a_task_of_a_package(capsys):
    with pytest.raises(SystemExit):
        main(["data", "collect", "--help"])
    assert "gymnasium:minigrid:MiniGrid-MemoryS7-v0" in capsys.readouterr().out


NODES = Graph(Box(-1.0, 1.0, (2,)), None)


@pytest.mark.parametrize(
    ("space", "sentence"),
    [
        (Sequence(Discrete(3)), "its observations have a Sequence, expected images, or numbers in Box"),
        (NODES, "its observations have a Graph"),
        (Tuple((Discrete(2), Sequence(Discrete(3)))), "its observations have a Sequence"),
        (Dict(a=Discrete(2), b=NODES), "its observations have a Graph"),
        (OneOf((Discrete(2), Discrete(3))), "its observations have a OneOf"),
        (Text(5), "its observations are text, expected numbers or images"),
    ],
)
def test_a_space_that_is_no_array_is_refused_by_name(space, sentence, monkeypatch):
    with pytest.raises(ForbesError, match="in a module of your own, and use: gymnasium:MODULE:ID") as error:
        environment_of(monkeypatch, space)
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"pixels": True},
            "it does not render images (render_mode rgb_array), as needed for pixels. Do not set pixels",
        ),
        ({"part": "image"}, "part is 'image', expected one of a Dict"),
    ],
)
def test_an_option_the_environment_lacks_is_one_sentence(options, sentence, monkeypatch):
    with pytest.raises(ForbesError) as error:
        environment_of(monkeypatch, **options)
    assert sentence in str(error.value)
