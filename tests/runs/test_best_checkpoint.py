"""The best checkpoint of a run stays, whatever comes after it."""

import math
from pathlib import Path

import pytest
import torch
from small_agents import fit, forbes, write_config

from forbes.commands.cli import main
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.saving import AtomicCheckpointIO
from forbes.training import WorldModel


@pytest.fixture
def measuring(monkeypatch):
    """Let the validations of the epochs give these numbers."""

    def measuring(values, objective="elbo"):
        def validation_step(self, batch, batch_idx):
            self.log(f"val/{objective}", torch.tensor(values[self.current_epoch]))

        monkeypatch.setattr(WorldModel, "validation_step", validation_step)
        monkeypatch.setattr(WorldModel, "objective_name", objective)

    return measuring


def updates(run):
    """The updates of the last checkpoint and of the best."""
    folder = RunFolder(run).checkpoint.parent
    return [read_checkpoint(folder / name)["global_step"] for name in ("last.ckpt", "best.ckpt")]


@pytest.mark.parametrize(
    ("objective", "values", "best"),
    [
        ("elbo", [-3.0, -1.0, -2.0, -1.0], 10),  # epochs of five updates
        ("elbo", [math.nan, -3.0, math.inf, -2.0], 20),
        ("loss", [3.0, 1.0, 2.0, 1.0], 10),
    ],
)
def test_the_best_is_that_of_the_best_validation(tiny_config, tmp_path, measuring, objective, values, best):
    measuring(values, objective)
    fit_it = ["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run")]

    assert main([*fit_it, "--trainer.max_epochs", "4"]) == 0

    assert updates(tmp_path / "run") == [20, best]


def test_a_resumed_run_knows_the_best_before_it(tiny_config, tmp_path, measuring):
    measuring([-3.0, -1.0, -2.0, -0.5])
    run = tmp_path / "run"
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 0

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 0
    assert updates(run) == [15, 10]

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "4"]) == 0
    assert updates(run) == [20, 20]
    last, best = (RunFolder(run).checkpoint.with_name(name) for name in ("last.ckpt", "best.ckpt"))
    assert last.samefile(best)  # it takes no room of its own


def test_a_run_without_a_validation_has_no_best(tiny_config, tmp_path):
    run = tmp_path / "run"
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run), "--trainer.limit_val_batches", "0"]) == 0

    assert not RunFolder(run).checkpoint.with_name("best.ckpt").exists()


def test_the_best_agent_by_return_is_kept_and_can_be_measured(tmp_path):
    run = tmp_path / "run"
    assert fit("--config", write_config(tmp_path), "--run_dir", run) == 0

    returns = read_metrics(run)["return/acting"].dropna()
    assert len(returns) == 2
    assert updates(run) == [12, returns.idxmax()]
    assert forbes("evaluate", run, "--checkpoint", "best.ckpt", "--episodes", 2) == 0
    assert (run / "evaluation-best" / "evaluation.json").is_file()


class Killed(BaseException):
    """Stands for SIGKILL, which no handler of errors sees."""


def test_after_a_kill_the_last_checkpoint_never_beats_the_best(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    for update in (1, 2):
        checkpoint = {"global_step": update, "best": {"metric": "val/elbo", "value": -1.0, "update": update}}
        if update == 2:
            monkeypatch.setattr(Path, "replace", kill_at_last(Path.replace))
            with pytest.raises(Killed):
                AtomicCheckpointIO().save_checkpoint(checkpoint, path)
        else:
            AtomicCheckpointIO().save_checkpoint(checkpoint, path)

    found = [read_checkpoint(tmp_path / name)["global_step"] for name in ("last.ckpt", "best.ckpt", "previous.ckpt")]
    assert found == [1, 2, 1]


def kill_at_last(replace):
    def kill(self, target):
        if Path(target).name == "last.ckpt":
            raise Killed
        return replace(self, target)

    return kill
