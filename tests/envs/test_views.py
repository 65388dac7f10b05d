"""Views: each shows what its definition says, and neither rewards nor the simulator notice."""

from functools import partial

import numpy as np
import pytest
from toy_environments import Parrot, Slide

from forbes.commands.cli import main
from forbes.data.episodes.collection import play, random_policy
from forbes.data.episodes.store import EpisodeStore
from forbes.envs import DeepMindControl, Environment, EnvironmentProcess, Gymnasium, Step, find_environment
from forbes.envs.base import check_environment, check_step
from forbes.envs.views import VIEWS, BlankUntil, Delay, Flicker, Hide, Noise, Occlude, look_through
from forbes.errors import ForbesError

SETTINGS = {"flicker": 0.5, "occlude": [0.25, 0, 0.75, 0.5], "noise": 0.2, "delay": 3, "blank_until": 4, "hide": [1]}
OF_IMAGES, OF_VECTORS = (
    [{name: SETTINGS[name]} for name in SETTINGS if name != "hide"],
    [{name: SETTINGS[name]} for name in ("hide", "flicker", "noise", "delay")],
)
POSITIONS = {  # what is left of the six tasks of the paper, by the suite's names
    "cartpole_swingup": {"position": 3},
    "finger_spin": {"position": 4},
    "cheetah_run": {"position": 8},
    "walker_walk": {"orientations": 14, "height": 1},
    "walker_run": {"orientations": 14, "height": 1},
    "hopper_stand": {"position": 6},
}
Z = 5  # standard errors: a false alarm in 2e6 tests


class Ones(Environment):
    """Always shows ones, or grey pixels, and ends after some steps."""

    action_dim = 1

    def __init__(self, shape=(40,), steps=400):
        self.observation_shape, self.steps = shape, steps

    def reset(self, seed):
        self.time = 0
        return Step(self.seen())

    def step(self, action):
        self.time += 1
        return Step(self.seen(), float(action[0]), truncated=self.time == self.steps)

    def seen(self):
        return np.ones(self.observation_shape, np.float32) if len(self.observation_shape) == 1 else self.grey()

    def grey(self):
        return np.full(self.observation_shape, 128, np.uint8)


def observations(environment, seed=0, steps=None):
    """The observations of an episode under the random policy, `(T + 1, ...)`."""
    return play(environment, random_policy(environment, 7), seed).observation


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one[:3], other[:3], strict=True)) and one[3:] == other[3:]


@pytest.mark.parametrize(
    ("make", "views"),
    [(Slide, views) for views in [*OF_IMAGES, {"noise": 0.1, "delay": 2, "flicker": 0.3}]]
    + [(Parrot, views) for views in [*OF_VECTORS, {"hide": [0], "noise": 0.1, "delay": 1}]],
    ids=str,
)
def test_episode_is_a_function_of_its_seed_with_true_rewards(make, views):
    seen = look_through(make, views)

    first, other, again = (play(seen, random_policy(seen, 7), seed) for seed in (1, 2, 1))
    true = play(make(), random_policy(make(), 7), 1)

    assert same(first, again)
    assert not np.array_equal(first.observation, other.observation)  # the toys show their seed
    assert not np.array_equal(first.observation, true.observation)
    np.testing.assert_array_equal(first.action, true.action)
    np.testing.assert_array_equal(first.reward, true.reward)
    assert (first.terminated, first.frames) == (true.terminated, true.frames)
    assert first.observation.dtype == true.observation.dtype
    check_environment(seen)
    check_step(seen.reset(0), seen.observation_shape)


@pytest.mark.parametrize("probability", [0.1, 0.5, 0.9])
def test_flicker_blanks_at_its_rate_and_independently(probability):
    blank = np.concatenate(
        [(observations(Flicker(Ones((1,)), probability), seed) == 0).all(-1) for seed in range(10)]
    )  # (10 * 401,)

    std = np.sqrt(probability * (1 - probability) / len(blank))
    assert abs(blank.mean() - probability) < Z * std
    assert abs(blank.mean() - (probability + 0.1)) > Z * std  # the test has the power to see a wrong rate
    both = (blank[1:] & blank[:-1]).mean()
    assert abs(both - probability**2) < Z * np.sqrt(3 / len(blank)) * probability  # neighbours are m-dependent, m = 1


@pytest.mark.parametrize("probability", [0, 1])
def test_flicker_at_its_limits_shows_all_or_nothing(probability):
    assert (observations(Flicker(Ones(), probability)) == 1 - probability).all()


@pytest.mark.parametrize(("shape", "std"), [((40,), 0.3), ((3, 8, 8), 0.1)])
def test_noise_has_the_variance_asked_for(shape, std):
    clean = Ones(shape)
    noise = observations(Noise(Ones(shape), std)).astype(np.float64) - clean.seen()
    expected = std**2 if len(shape) == 1 else (255 * std) ** 2 + 1 / 12  # rounding adds 1/12 (Sheppard)

    spread = expected * np.sqrt(2 / noise.size)  # of a normal's sample variance
    assert abs(noise.var() - expected) < Z * spread
    assert abs(noise.var() - 1.1 * expected) > Z * spread
    assert abs(noise.mean()) < Z * np.sqrt(expected / noise.size)
    lag = (noise[1:] * noise[:-1]).mean()
    assert abs(lag) < Z * expected / np.sqrt(noise.size)


def test_noise_of_an_image_ends_at_black_and_white():
    shown = observations(Noise(Ones((1, 8, 8)), 10.0))

    assert shown.dtype == np.uint8
    assert (shown == 0).mean() > 0.4
    assert (shown == 255).mean() > 0.4


@pytest.mark.parametrize("steps", [0, 1, 3, 20])
@pytest.mark.parametrize("make", [Slide, Parrot])
def test_delay_shows_what_was_seen_k_steps_before(make, steps):
    true, late = observations(make()), observations(Delay(make(), steps))

    np.testing.assert_array_equal(late[steps:], true[: max(0, len(true) - steps)])
    assert not late[:steps].any()


class OneBuffer(Parrot):
    """Writes each observation into the same array."""

    def reset(self, seed):
        self.buffer = super().reset(seed).observation.copy()
        return Step(self.buffer)

    def step(self, action):
        step = super().step(action)
        self.buffer[:] = step.observation
        return step._replace(observation=self.buffer)


def test_what_is_delayed_does_not_change_meanwhile():
    np.testing.assert_array_equal(observations(Delay(OneBuffer(), 2)), observations(Delay(Parrot(), 2)))


@pytest.mark.parametrize("steps", [0, 3, 100])
def test_blank_until_shows_nothing_and_then_all(steps):
    true, shown = observations(Parrot()), observations(BlankUntil(Parrot(), steps))

    assert not shown[:steps].any()
    np.testing.assert_array_equal(shown[steps:], true[steps:])


def test_occlude_blanks_exactly_its_box():
    true, shown = observations(Slide()), observations(Occlude(Slide(), [0.25, 0, 0.75, 0.5]))

    inside = np.zeros((8, 8), bool)
    inside[:4, 2:6] = True
    assert not shown[..., inside].any()
    np.testing.assert_array_equal(shown[..., ~inside], true[..., ~inside])


def test_the_order_of_views_is_that_of_the_options():
    late_noise = find_environment("Parrot", noise=0.1, delay=2)()
    noisy_delay = find_environment("Parrot", delay=2, noise=0.1)()

    assert late_noise.describe()["views"] == [{"noise": 0.1}, {"delay": 2}]
    assert noisy_delay.describe()["views"] == [{"delay": 2}, {"noise": 0.1}]
    assert not observations(late_noise)[:2].any()  # what has not arrived is not noisy
    assert observations(noisy_delay)[:2].all()
    assert isinstance(find_environment("Parrot", noise=None)(), Parrot)  # null switches a view off


def test_a_view_does_not_change_the_noise_of_another():
    alone, after = observations(Noise(Ones(), 0.1)), observations(Noise(Flicker(Ones(), 0.5), 0.1))

    np.testing.assert_array_equal(after[after.mean(-1) > 0.5], alone[after.mean(-1) > 0.5])


def look(environment):
    """All that a task of the suite measures now, `(O,)`."""
    measured = environment._environment.task.get_observation(environment._environment.physics)
    return np.concatenate([np.ravel(part) for part in measured.values()]).astype(np.float32)


def move(environment, qpos, qvel):
    """Put the simulator into a state."""
    physics = environment._environment.physics
    physics.data.qpos[:], physics.data.qvel[:] = qpos, qvel
    physics.forward()


def uniform(random, environment):
    return random.uniform(-1, 1, environment.action_dim).astype(np.float32)


CONTACT = {"touch", "touch_sensors"}  # a random policy rarely touches


@pytest.mark.parametrize("task", [*POSITIONS, "quadruped_walk", "manipulator_bring_ball"])
def test_hidden_velocities_are_all_that_depends_on_them(task):
    environment, random = DeepMindControl(task, pixels=False, action_repeat=1), np.random.default_rng(0)
    data = environment._environment.physics.data
    environment.reset(0)
    moves = np.zeros(environment.observation_shape, bool)
    for _ in range(30):
        environment.step(uniform(random, environment))
        qpos, qvel, before = data.qpos.copy(), data.qvel.copy(), look(environment)
        move(environment, qpos, qvel + random.normal(size=qvel.shape))
        moves |= look(environment) != before
        move(environment, qpos, qvel)

    parts = environment.named_parts()
    hidden, moved = set(parts["velocities"]), set(np.flatnonzero(moves))
    assert moved <= hidden
    assert hidden - {index for name in CONTACT & set(parts) for index in parts[name]} <= moved


@pytest.mark.parametrize("task", POSITIONS)
def test_positions_alone_are_a_function_of_qpos(task):
    seen, other = find_environment(task, pixels=False, hide="velocities")(), DeepMindControl(task, pixels=False)
    inner, random = seen.environment, np.random.default_rng(1)
    data = inner._environment.physics.data
    other.reset(9)

    assert seen.observation_shape == (sum(POSITIONS[task].values()),)
    assert {name: len(part) for name, part in seen.named_parts().items()} == POSITIONS[task]
    for seed in range(3):
        shown = seen.reset(seed).observation
        for _ in range(20):
            move(other, data.qpos, random.normal(size=data.qvel.shape))
            np.testing.assert_array_equal(shown, np.delete(look(other), inner.named_parts()["velocities"]))
            assert not np.array_equal(look(inner), look(other))  # with its velocities it is another state
            shown = seen.step(uniform(random, seen)).observation


def hidden_by(task, part):
    return find_environment(task, hide=part)().describe()["views"]


def test_hide_drops_the_named_dimensions_of_gymnasium():
    pytest.importorskip("gymnasium")
    true, shown = (observations(find_environment("gymnasium:CartPole-v1", **o)()) for o in ({}, {"hide": "velocities"}))

    np.testing.assert_array_equal(shown, true[:, [0, 2]])
    assert (
        hidden_by("gymnasium:CartPole-v1", [1, 3])
        == [{"hide": [1, 3]}]
        == hidden_by("gymnasium:CartPole-v1", "velocities")
    )
    assert hidden_by("gymnasium:Pendulum-v1", 2) == [{"hide": [2]}]
    assert hidden_by("gymnasium:HalfCheetah-v5", "velocities") == [{"hide": list(range(8, 17))}]
    assert Gymnasium("CartPole-v1").named_parts() == {"velocities": [1, 3]}
    assert Gymnasium("Hopper-v5").named_parts()["qpos"] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("task", "size", "parts"),
    [("mountain_hike", 2, [0]), ("tiger", 2, 1), ("multi_start_hike", 2, [1]), ("t_maze", 3, [0, 2])],
)
def test_known_processes_can_be_viewed_too(task, size, parts):
    true, shown = (observations(find_environment(task, **options)()) for options in ({}, {"hide": parts}))

    np.testing.assert_array_equal(shown, np.delete(true, parts, -1))
    assert true.shape[1] == size or task == "t_maze"


class Roomy(Parrot):
    """Has an option of its own that is also the name of a view."""

    def __init__(self, noise=0.0):
        super().__init__()
        self.noise = noise


def test_an_option_of_the_environment_comes_before_a_view():
    environment = find_environment("Roomy", noise=0.5, delay=1)()

    assert isinstance(environment, Delay)
    assert environment.environment.noise == 0.5


@pytest.mark.parametrize(
    ("make", "views", "sentence"),
    [
        (Parrot, {"hide": "speed"}, "Parrot: hide is 'speed', expected an index from 0 to 1. Change it"),
        (Parrot, {"hide": 2}, "expected an index from 0 to 1"),
        (Parrot, {"hide": -1}, "hide is -1, expected an index from 0 to 1"),
        (Parrot, {"hide": True}, "hide is True, expected an index"),
        (Parrot, {"hide": [0, 1]}, "expected at least one of the 2 dimensions, and not all of them"),
        (Parrot, {"hide": []}, "expected at least one of the 2 dimensions"),
        (Slide, {"hide": [0]}, "expected vectors to hide parts of, not images"),
        (Parrot, {"occlude": [0, 0, 1, 1]}, "expected images to occlude, not vectors"),
        (Slide, {"occlude": 0.5}, "occlude is 0.5, expected left, top, right and bottom as fractions in [0, 1]"),
        (Slide, {"occlude": [0, 0, 2, 1]}, "expected left, top, right and bottom as fractions in [0, 1]"),
        (Slide, {"occlude": [0.5, 0, 0.5, 1]}, "expected a box of at least one of the 8 x 8 pixels"),
        (Parrot, {"flicker": 1.5}, "flicker is 1.5, expected a probability in [0, 1]"),
        (Parrot, {"flicker": "often"}, "flicker is 'often', expected a probability"),
        (Parrot, {"noise": -1}, "noise is -1, expected a standard deviation of at least 0"),
        (Parrot, {"noise": float("nan")}, "noise is nan, expected a standard deviation"),
        (Parrot, {"delay": 1.5}, "delay is 1.5, expected a number of agent steps, at least 0"),
        (Parrot, {"blank_until": -1}, "blank_until is -1, expected a number of agent steps, at least 0"),
        (
            partial(DeepMindControl, "hopper_stand", pixels=False),
            {"hide": ["position", "speed"]},
            "hopper_stand: hide is ['position', 'speed'], expected one of position, velocity, touch, velocities, or an "
            "index from 0 to 14. Change it",
        ),
    ],
    ids=str,
)
def test_what_a_view_cannot_show_is_one_sentence(make, views, sentence):
    with pytest.raises(ForbesError) as error:
        look_through(make, views)

    assert sentence in str(error.value)


def test_what_a_view_cannot_show_is_the_same_sentence_from_another_process():
    make = partial(look_through, Parrot, {"hide": "speed"})

    with pytest.raises(ForbesError, match="Parrot: hide is 'speed', expected an index from 0 to 1"):
        EnvironmentProcess(make)


def test_collected_episodes_record_their_views(tmp_path, capsys):
    def collect(*flags, code=0):
        arguments = ("--episodes", "2", "-o", str(tmp_path / "store"))
        task = ("--allow-module", "toy_environments", "data", "collect", "--task", "Parrot")
        assert main([*task, *arguments, *map(str, flags)]) == code

    collect("--delay", 2, "--noise", 0.1, "--hide", 1)

    (record, *_) = EpisodeStore(tmp_path / "store").records.values()
    assert record.environment["views"] == [{"delay": 2}, {"noise": 0.1}, {"hide": [1]}]
    assert record.environment["observation_shape"] == [1]
    capsys.readouterr()
    for flags in [("--noise", 0.1, "--delay", 2, "--hide", 1), ("--delay", 2, "--noise", 0.1, "--flicker", 0)]:
        collect(*flags, "--episodes", 3, code=2)
        assert "has episodes whose " in capsys.readouterr().err
    assert set(VIEWS) == {"hide", "flicker", "occlude", "noise", "delay", "blank_until"}
    assert Hide is VIEWS["hide"]
