"""A training that has got worse than it was at its first validation says so, once."""

from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks import Checkpoint

from forbes.callbacks.collapse import WarnOfCollapse
from forbes.commands.cli import main

BOUND = "val/elbo[bernoulli,S=1]"


def warned(capsys, *values, saving=True, **others):
    """What is printed for these validation bounds, one after each epoch."""
    callback, module = WarnOfCollapse(), SimpleNamespace(objective_name="elbo[bernoulli,S=1]")
    for number, value in enumerate(values, start=1):
        metrics = {BOUND: torch.tensor(value)} | others
        trainer = SimpleNamespace(
            callback_metrics=metrics,
            global_step=500 * number,
            is_global_zero=True,
            checkpoint_callback=Checkpoint() if saving else None,
        )
        callback.on_train_epoch_end(trainer, module)
    return capsys.readouterr().err


@pytest.mark.parametrize("values", [[-50.0], [-50.0, -40.0, -45.0, -50.0], [50.0, 60.0, 55.0]])
def test_a_training_that_goes_up_and_down_above_its_first_bound_is_healthy(capsys, values):
    assert warned(capsys, *values) == ""


def test_a_bound_below_the_first_is_reported_once_with_both_values_and_what_to_do(capsys):
    line = warned(capsys, -50.0, -40.0, -219.5, -300.0, -250.0)

    assert line.count("\n") == 1
    assert f"{BOUND} is -219.5, below the -50.0 of update 500" in line
    assert "Lower --model.learning_rate or --model.clip_norm" in line


@pytest.mark.parametrize("saving", [True, False])
def test_the_best_checkpoint_is_named_only_where_one_is_saved(capsys, saving):
    assert ("checkpoints/best.ckpt has its best" in warned(capsys, -50.0, -219.5, saving=saving)) == saving


def test_the_bounds_of_an_agent_are_not_compared(capsys):
    assert warned(capsys, -50.0, -219.5, env_steps=torch.tensor(1000.0)) == ""


def test_fit_reports_a_collapse_and_trains_to_the_end(tiny_config, tmp_path, capsys):
    arguments = ["--trainer.max_epochs", "4", "--model.learning_rate", "0.2", "--model.schedule", "constant"]
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run"), *arguments]) == 0

    assert capsys.readouterr().err.count("the training may have collapsed") == 1
