"""Figure 4 of data without digits, and what it cannot be drawn of."""

import numpy as np
import pytest
import torch
import yaml
from command_line import error_of

from forbes.commands.cli import main
from forbes.data.episodes.episode import Episode
from forbes.data.episodes.store import EpisodeWriter
from forbes.evaluation.runs import load_runs
from forbes.figures.families import group
from forbes.figures.prediction_grid import prediction_grid
from forbes.figures.predictions import predictions

ENVIRONMENT = {"task": "Fading", "observation_shape": [3, 8, 8], "action_dim": 1, "discrete": False}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A world model of stored episodes of colour frames."""
    folder = tmp_path_factory.mktemp("episodes")
    random = np.random.default_rng(0)
    with EpisodeWriter(folder / "store") as writer:
        for _ in range(20):
            frames = random.integers(0, 256, (8, 3, 8, 8), dtype=np.uint8)
            whole = Episode(frames, np.zeros((8, 1), np.float32), np.zeros(8, np.float32), False, frames=7)
            writer.append(whole, seed=0, policy="test", environment=ENVIRONMENT)
    sizes = {"state_dim": 2, "hidden_dim": 4, "mlp_dim": 8, "mlp_layers": 1}
    parts = {name: {"class_path": f"MLP{name.title()}", "init_args": {"width": 8}} for name in ("encoder", "decoder")}
    model = {"belief": {"class_path": "GaussianBelief"}, "likelihood": {"class_path": "Normal"}, **parts, **sizes}
    source = {"class_path": "Replay", "init_args": {"path": str(folder / "store"), "hold_out": 5}}
    data = {"source": source, "batch_size": 4, "length": 6, "updates_per_epoch": 2, "validation_sequences": 4}
    config = {
        "model": {"class_path": "WorldModel", "init_args": model},
        "data": {"class_path": "SequenceDataModule", "init_args": data},
        "trainer": {"max_epochs": 1, "callbacks": [], "enable_progress_bar": False},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    assert main(["fit", "--config", str(folder / "config.yaml"), "--run_dir", str(folder / "rssm-0")]) == 0
    return str(folder / "rssm-0")


def test_frames_of_episodes_are_predicted_as_digits_are(run, tmp_path):
    assert main(["figures", "predictions", "--runs", run, "--context", "3", "-o", str(tmp_path)]) == 0

    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {"predictions-t6.png", "predictions-t6.pdf"}  # at the length of the data; an episode may be long


def test_what_is_no_drawing_of_strokes_has_no_probabilities(run, capsys, tmp_path):
    sentence = error_of(capsys, "figures", "4", "--runs", run, "--mean", "-o", tmp_path / "figures")
    assert sentence == f"--mean: the frames of {run} are expectations anyway, not sampled. Leave it out"


def test_truth_has_the_grey_values_of_its_completions(run):
    """A frame of one byte is as bright as its mean, not as the brightest pixel of the batch."""
    loaded = load_runs([run])[0]
    batch = loaded.data.sequences("test", torch.arange(2))
    grey = batch._replace(observation=torch.full_like(batch.observation, 102))

    (truth, seen, _) = prediction_grid(loaded.model, loaded.data, grey, 3, 1).axes[:3]
    figure = predictions(group([loaded]), loaded.data.source, grey, 6, 3, 1)

    for axes in (truth, seen, *figure.axes[:2]):
        frame = axes.images[0].get_array()
        assert frame[4, 4].tolist() == pytest.approx([102 / 255] * 3)
