"""`forbes rollout`: the video is of the episodes that `forbes evaluate` measures, in front of a camera if need be."""

import io
import shutil
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from small_agents import forbes
from toy_environments import Parrot

from forbes import GaussianBelief, MLPDecoder, MLPEncoder, VectorNormal, WorldModel
from forbes.commands.rollout import _camera
from forbes.data.episodes.collection import play, random_policy
from forbes.envs import Environment, EnvironmentProcess, Step, find_environment
from forbes.envs.views import look_through
from forbes.errors import ForbesError
from forbes.evaluation.agents import play_test_episode
from forbes.evaluation.films import camera_of, film
from forbes.evaluation.record import read_record
from forbes.figures.dreams import curves, dream
from forbes.training.loading import load_run


@pytest.fixture(scope="module")
def run(small_image_agent, tmp_path_factory):
    return shutil.copytree(small_image_agent, tmp_path_factory.mktemp("agent") / "run")


def test_the_video_shows_the_episodes_that_evaluate_measures(run, tmp_path, capsys):
    path = tmp_path / "new" / "agent.gif"

    assert forbes("rollout", run, "--video", path, "--episodes", 2, "--seed", 3) == 0

    *lines, last = capsys.readouterr().out.splitlines()
    assert last == str(path)
    assert forbes("evaluate", run, "--episodes", 2, "--seed", 3) == 0
    returns = read_record(str(run))["return[episodes=2]"]["returns"]
    assert lines == [
        f"episode {number}: return {earned:.2f}, 9 agent steps, 18 env steps"
        for number, earned in enumerate(returns, start=1)
    ]
    module, data = load_run(run)
    played = [play_test_episode(module, data.source.environment, 3, number).observation for number in (0, 1)]
    data.source.close()
    frames = [
        np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(Image.open(io.BytesIO(path.read_bytes())))
    ]
    expected = np.concatenate(played).transpose(0, 2, 3, 1).repeat(32, 1).repeat(32, 2)  # 256 pixels a side
    np.testing.assert_array_equal(frames, expected)
    assert [each.name for each in path.parent.iterdir()] == ["agent.gif"]


def test_refuses_what_cannot_be_filmed(run, small_agent, tiny_run, tmp_path, capsys):
    for arguments, message in [
        ((run, "--video", tmp_path / "agent.avi"), "agent.avi: it ends in .avi, expected .gif or .mp4. Rename it"),
        ((run, "--video", "/proc/agent.gif"), "/proc/"),
        ((run, "--video", tmp_path / "a.gif", "--device", "cuda:9"), "--device cuda:9: it cannot be used"),
        ((tiny_run, "--video", tmp_path / "a.gif"), "not the run of an agent, but of a WorldModel"),
        ((tmp_path / "absent", "--video", tmp_path / "a.gif"), "no such run folder"),
        ((small_agent, "--video", tmp_path / "a.gif"), "the observations are vectors of 2, expected images"),
    ]:
        assert forbes("rollout", *arguments) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert f"forbes evaluate {small_agent}" in error
    assert not list(tmp_path.glob("*.gif"))


def frames_of(path):
    film = Image.open(io.BytesIO(path.read_bytes()))
    return np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)])


def test_imagined_frames_are_beside_those_that_happened(run, tmp_path):
    path, plain = tmp_path / "dream.gif", tmp_path / "plain.gif"

    assert forbes("rollout", run, "--video", path, "--imagine", 4, "--seed", 3) == 0
    assert forbes("rollout", run, "--video", plain, "--seed", 3) == 0

    frames, happened = frames_of(path), frames_of(plain)
    assert frames.shape[1:] == (14 + 256, 2 * 256 + 3 * 4, 3)
    assert len(frames) == len(happened)
    error = np.abs(frames[:, 14:, 4:260].astype(int) - happened)
    assert np.median(error) == 0  # but for the palette of 256 colours, which two pictures share
    assert not np.array_equal(frames[:, 14:, 264:520], happened)


def test_a_grid_is_as_long_as_its_longest_episode(run, tmp_path):
    assert forbes("rollout", run, "--video", tmp_path / "grid.gif", "--episodes", 3, "--grid") == 0

    assert frames_of(tmp_path / "grid.gif").shape == (10, 2 * 256, 2 * 260 + 4, 3)


class Dial(Environment):
    """A number that the action moves, or, with `pixels`, a bar of that length; the camera may lie about the reward."""

    action_dim = 1

    def __init__(self, pixels=False, lies=False, steps=7):
        self.pixels, self.lies, self.steps = pixels, lies, steps
        self.observation_shape = (3, 8, 8) if pixels else (2,)

    def reset(self, seed):
        self.time, self.place = 0, seed % 4
        return Step(self.observed())

    def step(self, action):
        self.time += 1
        self.place = float(np.clip(self.place + action[0], 0, 8))
        return Step(self.observed(), self.place + self.lies * self.pixels, truncated=self.time == self.steps)

    def observed(self):
        if not self.pixels:
            return np.array([self.place, self.time], np.float32)
        frame = np.zeros((3, 8, 8), np.uint8)
        frame[:, :, : round(self.place)] = 255
        return frame


def test_an_episode_is_the_same_in_front_of_the_camera():
    seen = look_through(partial(Dial), {"hide": 1, "delay": 2})
    episode = play(seen, random_policy(seen, 1), seed=6)
    make = camera_of(partial(look_through, partial(Dial), {"hide": 1, "delay": 2}))

    frames = film(make(), episode, seed=6)

    places = np.concatenate([[6 % 4], episode.reward[1:]]).round()
    np.testing.assert_array_equal(frames[:, 0, 0].sum(-1) / 255, places)
    with pytest.raises(ForbesError, match="the same seed and actions earn other rewards with pixels than without"):
        film(Dial(pixels=True, lies=True), episode, seed=6)
    assert camera_of(Parrot) is None


def test_imagination_is_the_posterior_where_it_starts_and_the_prior_after():
    model = WorldModel(
        observation_shape=(2,),
        action_dim=1,
        encoder=partial(MLPEncoder, width=4, layers=1),
        decoder=partial(MLPDecoder, width=4, layers=1),
        likelihood=VectorNormal(),
        belief=GaussianBelief,
        state_dim=2,
        hidden_dim=3,
        mlp_dim=4,
    ).model.eval()
    environment = Dial(steps=9)
    episode = play(environment, random_policy(environment, 1), seed=6)
    changed = episode.observation.copy()
    changed[[1, 2, 3, 5, 6, 7, 9]] += 100  # what is imagined does not depend on what is seen meanwhile

    imagined, other = (dream(model, e, horizon=3, seed=0) for e in (episode, episode._replace(observation=changed)))

    assert imagined.shape == (10, 2)
    torch.testing.assert_close(imagined[:4], other[:4])
    assert not torch.equal(imagined[4:], other[4:])  # from here on it has seen the change


def test_curves_have_a_line_at_the_present_step():
    seen = np.random.default_rng(0).normal(size=(20, 11)).astype(np.float32)

    frames = curves(seen, seen + 1, horizon=4, height=256)

    assert frames.shape == (20, 3, 256, 384)
    moved = [np.flatnonzero((frames[t] != frames[0]).any((0, 1))).max() for t in range(1, 20)]
    assert moved == sorted(set(moved))


def test_every_imagined_step_is_drawn():
    """With one step of imagination, each second point was a gap, and nothing was drawn."""
    seen = np.zeros((40, 1), np.float32)

    orange = []
    for horizon in (1, 15):
        frame = curves(seen, seen + 1, horizon, height=256)[0].astype(int)
        orange.append(int(((frame[0] > 180) & (frame[2] < 120)).sum()))

    assert orange[0] > 0.3 * orange[1] > 0


def test_an_environment_that_does_not_render_is_drawn_as_curves(capsys):
    """Every environment of Gymnasium has the option `pixels`."""
    make = find_environment("gymnasium:popgym:popgym-RepeatPreviousEasy-v0")

    with EnvironmentProcess(make) as environment:
        assert _camera(environment) is None

    assert "no camera: popgym:popgym-RepeatPreviousEasy-v0: it does not render images" in capsys.readouterr().err


def test_an_agent_of_vectors_is_drawn_as_curves(small_agent, tmp_path):
    assert forbes("rollout", small_agent, "--video", tmp_path / "a.gif", "--imagine", 3) == 0

    assert frames_of(tmp_path / "a.gif").shape == (9, 14 + 256, 384 + 8, 3)
