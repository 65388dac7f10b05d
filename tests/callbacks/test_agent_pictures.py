"""What is seen of an agent that learns from images: open loop, futures, an episode, its returns."""

import io
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image, ImageSequence
from small_agents import fit, write_image_config

from forbes.callbacks import EpisodeVideo, ImaginedFutures, OpenLoopPanel, ReturnCurve
from forbes.callbacks.picture import shown_sequences
from forbes.evaluation.predictions import open_loop_frames
from forbes.evaluation.published import published_curves
from forbes.figures.imagination import draw_futures
from forbes.figures.returns import return_curve
from forbes.figures.style import BLUE
from forbes.figures.video import gif
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.training.acting import play_measured
from forbes.training.loading import load_run

CALLBACKS = (
    "{class_path: OpenLoopPanel, init_args: {sequences: 2, context: 2, columns: 4, every: 1}}",
    "{class_path: ImaginedFutures, init_args: {samples: 3, context: 2, columns: 3, every: 2}}",
    "{class_path: EpisodeVideo, init_args: {every: 2}}",
    "{class_path: ReturnCurve, init_args: {every: 1}}",
)
PANEL, FUTURES = OpenLoopPanel(2, 2, 4), ImaginedFutures(3, 2, 3)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("watched")
    assert fit("--config", write_image_config(folder, *CALLBACKS), "--run_dir", folder / "run") == 0
    return folder / "run"


@pytest.fixture
def trained(run, tmp_path):
    """The agent, its data and its episodes, as while it learns."""
    shutil.copytree(run, copy := tmp_path / "run")
    module, data = load_run(copy)
    data.source.open(copy / "episodes")
    yield module, data
    data.source.close()


def draw(callback, module, data, run=None):
    torch.manual_seed(0)
    callback.folder = run
    with torch.no_grad():
        return callback.draw(SimpleNamespace(), module, data)


def cells(axes, columns):
    """Cut the picture of a panel into its frames of 8 x 8 pixels, 2 apart: rows x columns."""
    pixels = np.asarray(axes.images[0].get_array())
    rows = (len(pixels) - 2) // 10
    return np.array([[pixels[10 * r + 2 :][:8, 10 * k + 2 :][:, :8] for k in range(columns)] for r in range(rows)])


def frames_of(content):
    """Give the frames of a GIF, shrunk to 8 x 8 pixels: (T, H, W, 3), with their times in milliseconds."""
    picture = Image.open(io.BytesIO(content))
    shown = [(np.asarray(each.convert("RGB")), each.info["duration"]) for each in ImageSequence.Iterator(picture)]
    assert shown[0][0].shape == (256, 256, 3)
    return np.array([frame[16::32, 16::32] for frame, _ in shown]), [time for _, time in shown]


def test_a_training_with_pictures_is_bitwise_the_one_without(run, tmp_path):
    assert fit("--config", write_image_config(tmp_path), "--run_dir", tmp_path / "run") == 0

    pd.testing.assert_frame_equal(read_metrics(run), read_metrics(tmp_path / "run"), check_exact=True)
    states = [read_checkpoint(RunFolder(path).checkpoint)["state_dict"] for path in (run, tmp_path / "run")]
    torch.testing.assert_close(*states, rtol=0, atol=0)
    names = {"open_loop.png", "futures.png", "episode.gif", "return.png"}
    assert {path.name for path in (run / "figures").iterdir()} == names


def test_seen_frames_are_reconstructed_and_later_ones_unused(trained):
    module, data = trained
    model = module.model
    batch = shown_sequences(data, 2, module)
    noise = torch.randint(256, batch.observation[:, 2:].shape, dtype=torch.uint8)
    other = batch._replace(observation=torch.cat((batch.observation[:, :2], noise), 1))
    outputs = []
    for each in (batch, other, batch._replace(action=-batch.action)):
        torch.manual_seed(3)
        outputs.append(open_loop_frames(model, each, context=2))
    torch.manual_seed(3)
    with torch.no_grad():
        filtered = model.filter(model.embed(batch.observation[:, :2]), batch.action[:, :2])
        imagined = model.imagine(filtered.at(1), batch.action[:, 2:])
        expected = [model.likelihood.mean(model.decode(each.features)) for each in (filtered, imagined)]

    torch.testing.assert_close(outputs[0], torch.cat(expected, 1))
    torch.testing.assert_close(outputs[1], outputs[0], rtol=0, atol=0)
    assert not torch.equal(outputs[2][:, 2:], outputs[0][:, 2:])  # but the actions do


def test_the_panel_shows_truth_model_and_halved_error(trained):
    module, data = trained
    batch = shown_sequences(data, 2, module)

    figure = draw(PANEL, module, data)

    assert [axes.get_title() for axes in figure.axes] == [
        "observed and reconstructed",
        "imagined for the true actions",
        "",
        "",
    ]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["truth", "model", "error"]
    assert [label.get_text() for label in figure.axes[3].get_xticklabels()] == ["t=3", "t=5"]
    torch.manual_seed(0)
    expected = open_loop_frames(module.model, batch, 2)
    for number in range(2):
        for axes, times in zip(figure.axes[2 * number :], ([0, 1], [2, 4]), strict=False):
            truth, model, error = cells(axes, 2)  # each (2, H, W, 3)
            true = batch.observation[number, times].permute(0, 2, 3, 1).numpy() / 255
            np.testing.assert_allclose(truth, true, atol=1e-6)
            np.testing.assert_allclose(model, expected[number, times].permute(0, 2, 3, 1), atol=1e-6)
            np.testing.assert_allclose(error, 0.5 + 0.5 * (model - truth), atol=1e-6)


def test_the_sequences_are_the_beginnings_of_the_newest_episodes(trained):
    module, data = trained
    store = data.source._replay.store

    batch = shown_sequences(data, 2, module)

    for sequence, number in zip(batch.observation, (3, 2), strict=True):
        np.testing.assert_array_equal(sequence, store.episode(number).observation[: data.length])


def test_futures_share_the_past_and_differ(trained):
    module, data = trained
    batch = shown_sequences(data, 1, module)

    figure = draw(FUTURES, module, data)

    truth, true_rest, past, futures = (
        cells(axes, count) for axes, count in zip(figure.axes, (2, 3, 2, 3), strict=True)
    )
    np.testing.assert_allclose(truth[0], batch.observation[0, :2].permute(0, 2, 3, 1) / 255, atol=1e-6)
    np.testing.assert_allclose(true_rest[0], batch.observation[0, 2:].permute(0, 2, 3, 1) / 255, atol=1e-6)
    for row in past:
        np.testing.assert_array_equal(row, truth[0])
    assert len(futures) == 3
    assert all((futures[k] != futures[j]).any() for k in range(3) for j in range(k))


def test_a_future_stands_at_its_own_step():
    """A frame whose grey is its time, counted from 1, out of 20."""
    time = torch.arange(1, 21).view(20, 1, 1, 1).expand(20, 3, 8, 8) / 20

    figure = draw_futures(time, time[5:].expand(2, -1, -1, -1, -1), context=5, columns=4, colour=BLUE)

    labels = [int(label.get_text()[2:]) for axes in figure.axes[2:] for label in axes.get_xticklabels()]
    assert labels == [2, 4, 5, 6, 11, 15, 20]
    shown = [cells(axes, count)[0, :, 0, 0, 0] for axes, count in zip(figure.axes[2:], (3, 4), strict=True)]
    np.testing.assert_allclose(np.concatenate(shown) * 20, labels, rtol=1e-6)


def test_the_video_is_the_episode_that_collect_measures_by(run, trained):
    module, data = trained
    environment = data.source.environment

    episode = play_measured(module, environment, "evaluation", seed=0, number=0)
    other = play_measured(module, environment, "evaluation", seed=0, number=1)

    frames, times = frames_of((run / "figures" / "episode.gif").read_bytes())
    np.testing.assert_array_equal(frames, episode.observation.transpose(0, 2, 3, 1))
    assert times == [40] * 9 + [1000]
    mean = (episode.total_reward + other.total_reward) / 2
    assert read_metrics(run)["return/acting"].dropna().iloc[-1] == pytest.approx(mean, rel=1e-6)


def test_a_grey_video_has_its_greys():
    grey = np.arange(3 * 64, dtype=np.uint8).reshape(3, 1, 8, 8)

    frames, _ = frames_of(gif([grey[:2], grey[2:]]))

    np.testing.assert_array_equal(frames, np.broadcast_to(grey, (3, 3, 8, 8)).transpose(0, 2, 3, 1))


def test_the_curve_has_every_return_at_its_env_steps(run, trained):
    figure = draw(ReturnCurve(), *trained, run)

    exploring, acting = figure.axes[0].lines
    metrics = read_metrics(run)
    assert list(exploring.get_xdata()) == [3 * 18, 4 * 18]  # two seed episodes before
    assert list(acting.get_xdata()) == [3 * 18, 4 * 18]  # after epochs 2 and 3
    np.testing.assert_allclose(acting.get_ydata(), metrics["return/acting"].dropna())
    assert figure.axes[0].get_title() == "Slide"


def test_published_curves_are_drawn_as_mean_and_range_of_seeds(tmp_path):
    curves = [
        ("dmc_cup_catch", 0, [0, 10_000, 20_000], [0, 1, 2]),
        ("dmc_cup_catch", 1, [0, 10_000], [4, 5]),
        ("dmc_x", 0, [0], [9]),
    ]
    path = tmp_path / "curves.json"
    named = [dict(task=task, method="dreamer", seed=seed, xs=xs, ys=ys) for task, seed, xs, ys in curves]
    path.write_text(json.dumps(named))
    metrics = pd.DataFrame({"env_steps": [5e3, 15e3], "return/acting": [3.0, 4.0]}, index=[1, 2])

    figure = return_curve(metrics, "cup", published_curves(str(path), "ball_in_cup_catch"))

    band = figure.axes[0].lines[0]
    assert band.get_label() == "Dreamer, published, 2 seeds"
    assert band.get_xydata().tolist() == [[0, 2], [10_000, 3]]
    assert set(figure.axes[0].collections[0].get_paths()[0].vertices[:, 1]) == {0, 1, 4, 5}
    assert figure.axes[0].get_xlim()[1] == pytest.approx(1.02 * 15e3)


def test_fetched_curves_are_drawn_by_default_for_their_task(tmp_path, monkeypatch):
    monkeypatch.setenv("FORBES_DATA", str(tmp_path))
    assert published_curves(None, "walker_walk") == {}  # not fetched

    named = [{"task": "dmc_walker_walk", "method": "dreamer", "seed": 0, "xs": [0, 10_000], "ys": [1, 2]}]
    (tmp_path / "dreamer-curves.json").write_text(json.dumps(named))

    (curve,) = published_curves(None, "walker_walk")["dreamer"]
    assert dict(curve) == {0: 1, 10_000: 2}
    assert published_curves(None, "mountain_hike") == {}


def test_a_curve_without_any_return_yet_is_empty():
    figure = return_curve(pd.DataFrame({"env_steps": [36.0]}), "task", {})

    assert [len(line.get_xdata()) for line in figure.axes[0].lines] == [0, 0]


@pytest.mark.parametrize(
    ("callback", "message"),
    [
        ("OpenLoopPanel, init_args: {context: 5}", "OpenLoopPanel: context is 5, expected less than the length 5"),
        ("OpenLoopPanel, init_args: {columns: 5}", "OpenLoopPanel: columns is 5, expected at least 6"),
        ("ImaginedFutures, init_args: {samples: 0}", "ImaginedFutures: samples is 0, expected at least 1"),
        ("ImaginedFutures, init_args: {context: 9}", "ImaginedFutures: context is 9, expected less than the length 5"),
        ("EpisodeVideo, init_args: {every: 0}", "EpisodeVideo: every is 0, expected at least 1"),
        ("ReturnCurve, init_args: {reference: absent.json}", "absent.json: no such file"),
        ("ReturnCurve, init_args: {reference: empty.json}", "empty.json: truncated or not JSON"),
        ("ReturnCurve, init_args: {reference: other.json}", "other.json: has no curve for Slide, only for dmc_walk"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_the_training(callback, message, in_tmp_path, capsys):
    (in_tmp_path / "empty.json").write_text("{]")
    (in_tmp_path / "other.json").write_text('[{"task": "dmc_walk", "method": "d", "seed": "0", "xs": [1], "ys": [2]}]')
    config = write_image_config(in_tmp_path, f"{{class_path: {callback}}}")

    assert fit("--config", config, "--run_dir", in_tmp_path / "run") == 2
    assert message in capsys.readouterr().err
    assert not RunFolder(in_tmp_path / "run").checkpoint.exists()


@pytest.mark.parametrize("callback", ["OpenLoopPanel", "ImaginedFutures", "EpisodeVideo"])
def test_vectors_are_no_pictures(callback, tmp_path, capsys):
    config = write_image_config(tmp_path, f"{{class_path: {callback}}}")
    config.write_text(config.read_text().replace("Slide", "Parrot").replace("Normal", "VectorNormal"))

    assert fit("--config", config, "--run_dir", tmp_path / "run") == 2
    assert f"{callback}: the observations are vectors of 2, expected images" in capsys.readouterr().err


@pytest.mark.parametrize("callback", [EpisodeVideo(), ReturnCurve()])
def test_a_world_model_alone_has_no_returns_and_no_episodes(callback, tiny_run):
    module, data = load_run(tiny_run)
    with pytest.raises(Exception, match="found a WorldModel on Strokes, expected an agent on Experience"):
        callback.on_fit_start(SimpleNamespace(datamodule=data), module)
