"""Pictures and hyperparameters reach the loggers of a run: TensorBoard's files are read back, W&B's calls are kept."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from lightning.pytorch.loggers import Logger
from PIL import Image

from forbes.commands.cli import main
from forbes.runs.loggers import show_picture, shows

PICTURES = """
trainer:
  callbacks:
    - {class_path: ElboCurve, init_args: {every: 1}}
    - {class_path: PredictionGrid, init_args: {digits: 2, samples: 1, context: 2}}
"""


class Board(Logger):
    """Takes pictures and videos as Lightning's `WandbLogger` does, which needs a package and a server."""

    name, version = "board", "0"
    kept: list[tuple[str, str, int | None]] = []  # noqa: RUF012
    hyperparameters: list[dict] = []  # noqa: RUF012

    def log_metrics(self, metrics, step=None):
        pass

    def log_hyperparams(self, params):
        self.hyperparameters.append(params)

    def log_image(self, key, images, step=None, **kwargs):
        assert all(Path(image).read_bytes().startswith(b"\x89PNG") for image in images)
        self.kept.append((key, *images, step))

    def log_video(self, key, videos, step=None, **kwargs):
        self.kept.append((key, *videos, step))


@pytest.fixture
def fit(tiny_config, in_tmp_path):
    """Train the tiny configuration with two pictures and the flags of a logger into the folder `run`."""
    Path("pictures.yaml").write_text(PICTURES)
    return lambda *flags: main(["fit", str(tiny_config), "pictures.yaml", "--run_dir", "run", *flags])


def test_tensorboard_shows_each_picture_and_the_hyperparameters(fit):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    assert fit("--trainer.logger", "TensorBoardLogger") == 0

    (events,) = Path("run").rglob("events.out.tfevents.*")
    board = accumulator.EventAccumulator(str(events), size_guidance={"images": 0}).Reload()
    shown = {tag: board.Images(tag) for tag in board.Tags()["images"]}
    assert {tag: [each.step for each in images] for tag, images in shown.items()} == {
        "figures/elbo": [5, 10],
        "figures/predictions": [10],
    }
    for tag, images in shown.items():
        last = np.asarray(Image.open(io.BytesIO(images[-1].encoded_image_string)))
        file = np.asarray(Image.open(f"run/{tag}.png").convert("RGB"))
        np.testing.assert_array_equal(last, file)
    hyperparameters = yaml.safe_load(events.with_name("hparams.yaml").read_text())
    assert hyperparameters == yaml.safe_load(Path("run/config.yaml").read_text())
    assert "_hparams_/session_start_info" in board.summary_metadata


def test_wandb_offline_keeps_each_picture(fit):
    pytest.importorskip("wandb")
    assert fit("--trainer.logger", "WandbLogger", "--trainer.logger.offline", "true") == 0

    kept = Path("run/wandb/latest-run/files/media/images/figures").glob("*.png")
    assert sorted(picture.name.split("_")[0] for picture in kept) == ["elbo", "elbo", "predictions"]


def test_a_logger_with_the_methods_of_wandb_gets_each_picture(fit, monkeypatch):
    monkeypatch.setitem(sys.modules, "a_board", sys.modules[__name__])
    monkeypatch.setattr(Board, "kept", [])
    monkeypatch.setattr(Board, "hyperparameters", [])
    monkeypatch.setattr(Board, "__module__", "a_board")

    assert fit("--allow-module", "a_board", "--trainer.logger", "a_board.Board") == 0

    elbo, predictions = (str(Path(f"run/figures/{name}.png")) for name in ("elbo", "predictions"))
    assert sorted(Board.kept) == [
        ("figures/elbo", elbo, 5),
        ("figures/elbo", elbo, 10),
        ("figures/predictions", predictions, 10),
    ]
    assert Board.hyperparameters == [yaml.safe_load(Path("run/config.yaml").read_text())]


def test_what_a_logger_does_not_show_is_said_once(fit, capsys):
    assert fit("--trainer.logger", "CSVLogger") == 0

    output = capsys.readouterr().out
    assert output.count("CSVLogger does not show elbo.png, predictions.png; see run/figures") == 1


def test_a_video_goes_where_videos_are_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(Board, "kept", [])
    board, path = Board(), tmp_path / "episode.gif"

    show_picture(board, path, 7)

    assert shows(board, path.name)
    assert board.kept == [("figures/episode", str(path), 7)]
