"""A training that diverges stops before the update, and loses nothing."""

import json
import os
import re
import shutil
import signal
from collections.abc import Mapping
from contextlib import redirect_stderr
from io import StringIO

import pytest
import torch
from small_agents import fit as agent_fit
from small_agents import forbes, write_config
from torch.optim import Adam

from forbes.commands.cli import main
from forbes.commands.replay import _FIELDS, _problem_of
from forbes.control.return_scale import ReturnScale
from forbes.data import SequenceBatch
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_config, read_metrics
from forbes.runs.saving import AtomicCheckpointIO
from forbes.seeding import derive_seed
from forbes.training.divergence import hold_unless_finite
from forbes.training.loading import load_run
from forbes.training.world_model import LossTerm, WorldModel

TOO_FAST = ["--model.learning_rate", "1e30"]


@pytest.fixture(scope="module")
def run_and_error(tiny_run, tmp_path_factory):
    """A run of ten updates that went on with a rate at which nothing stays finite; and what it printed."""
    run = RunFolder(shutil.copytree(tiny_run, tmp_path_factory.mktemp("diverged") / "run"))
    with redirect_stderr(StringIO()) as error:
        assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3", *TOO_FAST]) == 3
    return run, error.getvalue()


@pytest.fixture
def diverged(run_and_error, tmp_path):
    """A copy of the run, to be changed."""
    return RunFolder(shutil.copytree(run_and_error[0].path, tmp_path / "run"))


def test_the_last_finite_checkpoint_stays_and_advice_is_given(run_and_error, tiny_run):
    run, error = run_and_error

    assert run.checkpoint.read_bytes() == RunFolder(tiny_run).checkpoint.read_bytes()
    *_, line = error.splitlines()
    assert line.startswith(f"forbes: {run}: diverged, the loss or gradient of update 12 is not finite.")
    assert line.endswith(f"Give a lower --model.learning_rate to forbes fit --resume {run}")
    assert json.loads(run.provenance.read_text())[-1]["exit_status"] == 3
    assert read_metrics(run.path)["train/elbo[bernoulli,S=1]"].dropna().isna().sum() == 0


def test_it_goes_on_at_a_lower_rate(diverged):
    assert main(["fit", "--resume", str(diverged), "--trainer.max_epochs", "3", "--model.learning_rate", "1e-4"]) == 0


def test_the_update_can_be_computed_again(diverged):
    failure = torch.load(diverged.failure, weights_only=True)
    module, _ = load_run(diverged.path)
    module.load_state_dict(failure["state_dict"])
    assert all(parameter.isfinite().all() for parameter in module.parameters())
    (batch,) = (SequenceBatch(**values) for values in failure["batches"])

    torch.manual_seed(derive_seed(failure["seed"], "update", failure["update"]))
    loss, _ = module.total_loss(batch)
    loss.backward()

    gradients = [parameter.grad for parameter in module.parameters() if parameter.grad is not None]
    assert not torch.nn.utils.get_total_norm([loss, *gradients]).isfinite()


def test_replay_names_the_first_tensor_that_is_not_finite(diverged, capsys):
    """It is the output of a module of which the input and all weights are finite."""
    failure = read_checkpoint(diverged.failure)

    assert main(["replay", str(diverged.failure)]) == 0

    said = capsys.readouterr().out
    assert said.startswith(f"{diverged.failure}: update 12, recomputed on cpu: the first tensor that is not finite is ")
    name, kind = re.search(r"is the output of ([\w.]+) \((\w+)\): \d+ of \d+ values, shape \(", said).groups()
    module, _ = load_run(diverged.path)
    assert type(part := module.get_submodule(name)).__name__ == kind
    module.load_state_dict(failure["state_dict"])
    assert all(parameter.isfinite().all() for parameter in part.parameters())


def broken_loss(monkeypatch, at):
    """A loss that is finite at update 3 (from 0), and has a gradient that is not."""
    loss = WorldModel.loss

    def with_a_steep_root(self, terms):
        zero = sum(parameter.sum() for parameter in self.parameters()) * 0
        return loss(self, terms) + (zero.sqrt() if self.global_step == at else 0)

    monkeypatch.setattr(WorldModel, "loss", with_a_steep_root)


def test_replay_names_the_gradient_where_the_loss_is_finite(tiny_config, tmp_path, monkeypatch, capsys):
    """And the run needs no checkpoint."""
    broken_loss(monkeypatch, at=3)
    run = RunFolder(tmp_path / "run")
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 3

    assert main(["replay", str(run.failure)]) == 0

    assert "is the gradient of model." in capsys.readouterr().out


def test_replay_says_so_where_the_update_is_finite_now(tiny_config, tmp_path, monkeypatch, capsys):
    run = RunFolder(tmp_path / "run")
    with monkeypatch.context() as patch:
        broken_loss(patch, at=3)
        assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 3
    capsys.readouterr()

    assert main(["replay", str(run.failure)]) == 2

    assert "update 4, recomputed on cpu, is finite; it was not on cpu" in capsys.readouterr().err


def test_replay_repeats_noise_batches_and_weight_of_the_kl(tiny_config, tmp_path, monkeypatch):
    """Of the second update of the second epoch: its sixth batch, of an epoch of two, two and one."""
    seen = []
    total_loss = WorldModel.total_loss

    def remember(self, batch):
        loss, values = total_loss(self, batch)
        seen.append((self.global_step, loss.item()))
        broken = self.global_step == 4 and self._trainer.fit_loop.total_batch_idx == 8
        return LossTerm(loss * (torch.nan if broken else 1), values)

    monkeypatch.setattr(WorldModel, "total_loss", remember)
    run = RunFolder(tmp_path / "run")
    flags = ["--trainer.accumulate_grad_batches", "2", "--model.kl_warmup", "20", "--run_dir", str(run)]
    assert main(["fit", "--config", str(tiny_config), *flags]) == 3
    assert read_checkpoint(run.failure)["batch_numbers"] == [7, 8]
    trained = seen[-2:]
    assert [update for update, _ in trained] == [4, 4]

    assert main(["replay", str(run.failure)]) == 0

    assert seen[-2:] == trained


@pytest.mark.parametrize("late", [False, True], ids=["at once", "at the end of the epoch"])
def test_replay_sees_running_averages_before_the_update(late, tmp_path, monkeypatch):
    """The range of returns and the slow critic move without the optimiser; a GPU finds a divergence updates later."""
    seen = []
    forward = ReturnScale.forward

    def remember(self, returns, valid):
        before, scale = self.percentiles.clone(), forward(self, returns, valid)
        seen.append((before, scale, self.percentiles.clone()))
        return scale

    monkeypatch.setattr(ReturnScale, "forward", remember)
    broken_loss(monkeypatch, at=1)
    if late:
        monkeypatch.setattr("forbes.callbacks.divergence.StopAtDivergence.on_train_batch_end", lambda *_: None)
    config = write_config(tmp_path, "dreamer")
    config.write_text(
        config.read_text().replace("horizon: 3", "horizon: 3\n    scale_returns: true\n    slow_critic: 0.5")
    )
    run = RunFolder(tmp_path / "run")
    assert agent_fit("--config", config, "--run_dir", run) == 3
    assert len(seen) == (4 if late else 2)
    trained = seen[1]
    failure = read_checkpoint(run.failure)["state_dict"]
    assert torch.equal(failure["return_scale.percentiles"], trained[0])

    assert forbes("replay", run.failure) == 0

    assert all(map(torch.equal, seen[-1], trained))


def test_replay_repeats_the_noise_and_the_rows_of_each_process(diverged, monkeypatch):
    failure = read_checkpoint(diverged.failure)
    AtomicCheckpointIO().save_checkpoint(failure | {"processes": 2}, diverged.failure)
    [batch], seen = failure["batches"], []

    def remember(self, share):
        seen.append((share.observation, torch.initial_seed()))
        return LossTerm(sum(parameter.sum() for parameter in self.parameters()), {})

    monkeypatch.setattr(WorldModel, "total_loss", remember)
    assert main(["replay", str(diverged.failure)]) == 2  # this loss is finite

    assert torch.equal(torch.cat([rows for rows, _ in seen]), batch["observation"])
    purposes = ("update", "update/1")
    assert [seed for _, seed in seen] == [derive_seed(failure["seed"], purpose, 11) for purpose in purposes]


def change(failure, **values):
    return {name: value for name, value in (failure | values).items() if value is not None}


def test_replay_of_no_file_is_one_sentence(tiny_run, capsys):
    assert main(["replay", str(tiny_run / "failure.pt")]) == 2

    assert "no such file. Name the failure.pt in the folder of a run that diverged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"update": None}, "its update is NoneType, expected the failure.pt of a run that diverged"),
        ({"batches": [{}]}, "one of its batches lacks a field"),
        ({"batches": []}, "it does not have one number per batch"),
        ({"batches": [dict.fromkeys(SequenceBatch._fields, 1)]}, "one of its batches has values that are not tensors"),
        ({"processes": 3}, "its batches cannot be shared by 3 processes"),
        ({"state_dict": {}}, "it has no model."),
    ],
)
def test_replay_refuses_what_is_no_failure_in_one_sentence(diverged, capsys, changes, sentence):
    AtomicCheckpointIO().save_checkpoint(change(read_checkpoint(diverged.failure), **changes), diverged.failure)

    assert main(["replay", str(diverged.failure)]) == 2

    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert sentence in error


def test_a_batch_of_several_parts_is_one_to_replay():
    batch = dict.fromkeys(SequenceBatch._fields, torch.zeros(2, 3))
    batch["observation"] = {"camera": torch.zeros(2, 3, 1, 4, 4), "proprio": torch.zeros(2, 3, 2)}
    failure = {name: {} if kind is Mapping else kind() for name, kind in _FIELDS.items()}
    failure |= {"batches": [batch], "batch_numbers": [0]}

    assert _problem_of(failure) == ""
    batch["observation"] = batch["observation"] | {"proprio": None}
    assert _problem_of(failure) == "one of its batches has values that are not tensors"


LOWER_RATE = ["--on-divergence", "lower-rate"]


def diverging_above(monkeypatch, rate, at=12):
    """A loss that is not finite at an update (from 0) where the rate is above this."""
    loss = WorldModel.loss

    def unless_slow(self, terms):
        return loss(self, terms) * (torch.nan if self.learning_rate > rate and self.global_step == at else 1)

    monkeypatch.setattr(WorldModel, "loss", unless_slow)


def test_training_resumes_at_a_lower_rate_that_is_recorded(tiny_run, tmp_path, monkeypatch, capsys):
    """At 1 and 0.5 the third epoch diverges, at 0.25 it does not."""
    run = RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))
    diverging_above(monkeypatch, 0.25)
    flags = ["--trainer.max_epochs", "3", "--model.learning_rate", "1"]

    assert main(["fit", "--resume", str(run), *flags, *LOWER_RATE]) == 0

    said = capsys.readouterr().err
    assert [f"continues from update 10 with learning_rate {rate}" in said for rate in (0.5, 0.25)] == [True, True]
    lines = [json.loads(line) for line in run.metrics.read_text().splitlines()]
    noted = [line for line in lines if "divergence/update" in line]
    assert noted == [{"update": 10, "divergence/update": 13, "divergence/learning_rate": rate} for rate in (0.5, 0.25)]
    assert read_metrics(run.path).index.tolist() == [*range(1, 16)]
    assert read_config(run.config)["model"]["init_args"]["learning_rate"] == 0.25
    starts = json.loads(run.provenance.read_text())[1:]
    assert [start["exit_status"] for start in starts] == [3, 3, 0]


def test_a_lower_rate_begins_again_where_there_is_no_checkpoint(tiny_config, tmp_path, monkeypatch):
    run = tmp_path / "run"
    diverging_above(monkeypatch, 0.3, at=2)
    flags = ["--run_dir", str(run), "--model.learning_rate", "0.5", *LOWER_RATE]

    assert main(["fit", "--config", str(tiny_config), *flags]) == 0

    metrics = read_metrics(run)
    assert metrics.loc[0, "divergence/learning_rate"] == 0.25
    assert metrics.index.tolist() == [*range(11)]


def test_after_three_lower_rates_it_stops(tiny_config, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    diverging_above(monkeypatch, 0.0, at=1)

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run), *LOWER_RATE]) == 3

    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith(f"forbes: {run}: diverged, the loss or gradient of update 2 is not finite")
    lines = [json.loads(line) for line in RunFolder(run).metrics.read_text().splitlines()]
    assert sum("divergence/update" in line for line in lines) == 3
    starts = json.loads(RunFolder(run).provenance.read_text())
    assert [start["exit_status"] for start in starts] == [3] * 4


def test_a_signal_is_not_forgotten_where_the_epoch_then_diverges(tiny_run, tmp_path, monkeypatch):
    run = RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))
    loss = WorldModel.loss

    def interrupted(self, terms):
        os.kill(os.getpid(), signal.SIGINT)
        return loss(self, terms) * torch.nan

    monkeypatch.setattr(WorldModel, "loss", interrupted)

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3", *LOWER_RATE]) == 3

    assert "divergence/update" not in run.metrics.read_text()


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


def test_a_nonfinite_gradient_of_a_finite_loss_stops_training(tiny_config, tmp_path, monkeypatch, capsys):
    broken_loss(monkeypatch, at=3)
    run = tmp_path / "run"

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 3

    assert "the loss or gradient of update 4 is not finite" in capsys.readouterr().err
    assert not RunFolder(run).checkpoint.exists()


def test_parameters_that_are_not_finite_are_never_saved(tiny_run, tmp_path, monkeypatch, capsys):
    run = RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))
    before = run.checkpoint.read_bytes()
    monkeypatch.setattr("forbes.callbacks.divergence.StopAtDivergence._stop_if_held", lambda *_: None)

    def break_one(self, *_):
        next(self.parameters()).data.fill_(torch.nan)

    monkeypatch.setattr(WorldModel, "on_train_batch_end", break_one, raising=False)
    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 3

    assert "is not finite after update 15, so no checkpoint is written" in capsys.readouterr().err
    assert run.checkpoint.read_bytes() == before
