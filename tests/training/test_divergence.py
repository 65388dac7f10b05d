"""A training that diverges stops before the update, and loses nothing."""

import json
import shutil

import pytest
import torch
from torch.optim import Adam

from forbes.cli import main
from forbes.data import SequenceBatch
from forbes.seeding import derive_seed
from forbes.training.divergence import hold_unless_finite
from forbes.training.loading import load_run
from forbes.training.run_folder import RunFolder, read_metrics
from forbes.training.world_model import WorldModel

TOO_FAST = ["--model.learning_rate", "1e30"]


@pytest.fixture
def diverged(tiny_run, tmp_path, capsys):
    """A run of ten updates that went on with a rate at which nothing stays finite."""
    run = RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))
    before = run.checkpoint.read_bytes()
    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3", *TOO_FAST]) == 3
    return run, before, capsys.readouterr().err


def test_the_last_finite_checkpoint_stays_and_one_sentence_says_what_to_do(diverged):
    run, before, error = diverged

    assert run.checkpoint.read_bytes() == before
    *_, line = error.splitlines()
    assert line.startswith(f"forbes: {run}: diverged, the loss or gradient of update 12 is not finite.")
    assert line.endswith(f"Give a lower --model.learning_rate to forbes fit --resume {run}")
    assert json.loads(run.provenance.read_text())[-1]["exit_status"] == 3
    assert read_metrics(run.path)["train/elbo[bernoulli,S=1]"].dropna().isna().sum() == 0


def test_it_goes_on_at_a_lower_rate(diverged):
    run, *_ = diverged

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3", "--model.learning_rate", "1e-4"]) == 0


def test_the_update_can_be_computed_again(diverged):
    run, *_ = diverged
    failure = torch.load(run.failure, weights_only=True)
    module, _ = load_run(run.path)
    module.load_state_dict(failure["state_dict"])
    assert all(parameter.isfinite().all() for parameter in module.parameters())
    (batch,) = (SequenceBatch(**values) for values in failure["batches"])

    torch.manual_seed(derive_seed(failure["seed"], "update", failure["update"]))
    loss, _ = module.losses(batch)
    loss.backward()

    gradients = [parameter.grad for parameter in module.parameters() if parameter.grad is not None]
    assert not torch.nn.utils.get_total_norm([loss, *gradients]).isfinite()


@pytest.mark.parametrize("broken", [torch.nan, torch.inf])
def test_a_held_optimiser_changes_nothing_any_more(broken):
    weight = torch.nn.Parameter(torch.ones(3))
    optimizer = Adam([weight], fused=True)
    for update, norm in enumerate([1.0, 1.0, broken, 1.0]):
        weight.grad = torch.ones(3)
        hold_unless_finite(optimizer, torch.tensor(norm), update)
        optimizer.step()
        if update == 1:
            before = weight.detach().clone()

    torch.testing.assert_close(weight.detach(), before, rtol=0, atol=0)
    assert optimizer.held_from == 2
    assert optimizer.state[weight]["step"] == 2


def test_a_gradient_that_is_not_finite_stops_a_training_whose_loss_is(tiny_config, tmp_path, monkeypatch, capsys):
    loss = WorldModel.loss

    def with_a_steep_root(self, terms):
        zero = sum(parameter.sum() for parameter in self.parameters()) * 0
        return loss(self, terms) + (zero.sqrt() if self.global_step == 3 else 0)

    monkeypatch.setattr(WorldModel, "loss", with_a_steep_root)
    run = tmp_path / "run"

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 3

    assert "the loss or gradient of update 4 is not finite" in capsys.readouterr().err
    assert not RunFolder(run).checkpoint.exists()


def test_parameters_that_are_not_finite_are_never_saved(tiny_run, tmp_path, monkeypatch, capsys):
    run = RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))
    before = run.checkpoint.read_bytes()
    monkeypatch.setattr("forbes.training.divergence.StopAtDivergence._stop_if_held", lambda *_: None)

    def break_one(self, *_):
        next(self.parameters()).data.fill_(torch.nan)

    monkeypatch.setattr(WorldModel, "on_train_batch_end", break_one, raising=False)
    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 3

    assert "is not finite after update 15, so no checkpoint is written" in capsys.readouterr().err
    assert run.checkpoint.read_bytes() == before
