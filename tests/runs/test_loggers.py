"""Loggers of a configuration write into the run folder, unless they are told another one."""

import shutil
from functools import partial
from pathlib import Path
from unittest.mock import create_autospec

import pytest
import yaml
from command_line import error_of
from lightning.pytorch.loggers import CometLogger, LitLogger, MLFlowLogger, TensorBoardLogger, WandbLogger

from forbes.commands.cli import main
from forbes.runs.folder import read_metrics
from forbes.runs.loggers import open_logger

TENSORBOARD = ["--trainer.logger", "TensorBoardLogger"]


def files(folder, pattern):
    return list(Path(folder).rglob(pattern))


def test_a_logger_that_requires_a_folder_gets_the_run_folder(tiny_config, in_tmp_path):
    assert main(["fit", "--config", str(tiny_config), *TENSORBOARD, "--run_dir", "run"]) == 0

    assert len(files("run", "events.out.tfevents.*")) == 1
    assert [path.name for path in in_tmp_path.iterdir()] == ["run"]
    assert read_metrics("run").index.max() == 10


def test_several_loggers_of_a_file_get_the_run_folder(tiny_config, in_tmp_path):
    Path("loggers.yaml").write_text("trainer: {logger: [CSVLogger, {class_path: TensorBoardLogger}]}")

    assert main(["fit", "--config", str(tiny_config), "--config", "loggers.yaml", "--run_dir", "run"]) == 0

    assert len(files("run", "events.out.tfevents.*")) == len(files("run", "metrics.csv")) == 1


def test_a_run_that_was_moved_goes_on_logging_where_it_is(tiny_config, in_tmp_path):
    assert main(["fit", "--config", str(tiny_config), *TENSORBOARD, "--run_dir", "run"]) == 0
    shutil.move("run", "moved")

    assert main(["fit", "--resume", "moved", "--trainer.max_epochs", "3"]) == 0

    assert len(files("moved", "events.out.tfevents.*")) == 2
    assert not Path("run").exists()
    logger = yaml.safe_load(Path("moved/config.yaml").read_text())["trainer"]["logger"]
    assert logger["init_args"].get("save_dir") is None


def test_a_named_folder_stays_the_one_that_was_named(tiny_config, in_tmp_path):
    flags = [*TENSORBOARD, "--trainer.logger.save_dir", "named", "--run_dir", "run"]

    assert main(["fit", "--config", str(tiny_config), *flags]) == 0

    assert len(files("named", "events.out.tfevents.*")) == 1
    assert not files("run", "events.out.tfevents.*")


def test_validation_of_a_run_with_a_logger_writes_nothing(tiny_config, in_tmp_path):
    assert main(["fit", "--config", str(tiny_config), *TENSORBOARD, "--run_dir", "run"]) == 0
    before = files(".", "*")

    assert main(["validate", "--config", "run/config.yaml", "--ckpt_path", "run/checkpoints/last.ckpt"]) == 0

    assert files(".", "*") == before


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("TensorBoardLogger", "needs tensorboard, which is not installed. Install it: pip install 'forbes[tracking]'"),
        ("WandbLogger", "needs wandb, which is not installed. Install it: pip install wandb"),
        ("MLFlowLogger", "needs mlflow, which is not installed. Install it: pip install mlflow"),
        ("CometLogger", "needs comet_ml, which is not installed. Install it: pip install comet-ml"),
    ],
)
def test_a_logger_without_its_package_says_what_to_install(
    name, sentence, tiny_config, in_tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("forbes.runs.loggers.find_spec", lambda module: None)

    said = error_of(capsys, "fit", "--config", tiny_config, "--trainer.logger", name, "--run_dir", "run")

    assert said == f"trainer.logger: {name} {sentence}"
    assert not Path("run").exists()


@pytest.mark.parametrize(
    ("kind", "given", "expected"),
    [
        (TensorBoardLogger, {"save_dir": None}, {"save_dir": "run"}),
        (WandbLogger, {"save_dir": "."}, {"save_dir": "run"}),
        (WandbLogger, {"save_dir": "mine"}, {"save_dir": "mine"}),
        (MLFlowLogger, {"save_dir": "./mlruns"}, {"save_dir": "run/mlruns"}),
        (MLFlowLogger, {"save_dir": "/mine"}, {"save_dir": "/mine"}),
        (LitLogger, {"root_dir": None}, {"root_dir": "run"}),
        (CometLogger, {"project": "mine"}, {"project": "mine"}),
    ],
)
def test_a_default_folder_is_relative_to_the_run_folder(kind, given, expected):
    instead = create_autospec(kind)  # most of them need a package and a server

    open_logger(partial(instead, **given), Path("run"))

    instead.assert_called_once_with(**expected)
