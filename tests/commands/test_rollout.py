"""`forbes rollout`: the video is of the episodes that `forbes evaluate` measures."""

import io

import numpy as np
import pytest
from PIL import Image, ImageSequence
from small_agents import fit, forbes, write_config, write_image_config

from forbes.evaluation.agents import play_test_episode
from forbes.evaluation.record import read_record
from forbes.training.loading import load_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    config = write_image_config(folder)
    assert fit("--config", config, "--run_dir", folder / "run", "--trainer.max_epochs", 1) == 0
    return folder / "run"


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


def test_refuses_what_cannot_be_filmed(run, tiny_run, tmp_path, capsys):
    vectors = tmp_path / "vectors"
    assert fit("--config", write_config(tmp_path), "--run_dir", vectors, "--trainer.max_epochs", 1) == 0
    capsys.readouterr()

    for arguments, message in [
        ((run, "--video", tmp_path / "agent.mp4"), "agent.mp4: it ends in .mp4, expected .gif. Rename it"),
        ((run, "--video", "/proc/agent.gif"), "/proc/"),
        ((run, "--video", tmp_path / "a.gif", "--device", "cuda:9"), "--device cuda:9: it cannot be used"),
        ((tiny_run, "--video", tmp_path / "a.gif"), "not the run of an agent, but of a WorldModel"),
        ((tmp_path / "absent", "--video", tmp_path / "a.gif"), "no such run folder"),
        ((vectors, "--video", tmp_path / "a.gif"), "the observations are vectors of 2, expected images"),
    ]:
        assert forbes("rollout", *arguments) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert f"forbes evaluate {vectors}" in error
    assert not list(tmp_path.glob("*.gif"))
