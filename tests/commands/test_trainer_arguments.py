"""Every argument of Lightning's Trainer does what it says, or is refused in one sentence."""

import inspect
import logging
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from lightning import Trainer

from forbes.commands.cli import main
from forbes.data import SequenceDataModule
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.training import seeded

DEVICES = "expected a number above 0, or indices as [0,1]. The noise depends on the number"
FLOAT32 = "expected 32-true or bf16-mixed. Densities and the recurrence are computed in float32"
REFUSED = [
    ("devices", "0", f"is 0, {DEVICES}"),
    ("devices", "-1", f"is -1, {DEVICES}"),
    ("devices", "auto", f"is auto, {DEVICES}"),
    ("num_nodes", "2", "is 2, expected 1. Start the processes on several machines with torchrun or SLURM"),
    ("strategy", "fsdp", "is fsdp, expected auto or ddp. Each device has the whole model"),
    ("precision", "64-true", f"is 64-true, {FLOAT32}"),
    ("precision", "bf16-true", f"is bf16-true, {FLOAT32}"),
    ("precision", "16-mixed", f"is 16-mixed, {FLOAT32}"),
    ("plugins", "DoublePrecision", "is DoublePrecision, expected none of precision. Set --trainer.precision"),
    ("gradient_clip_val", "0.1", "is 0.1, expected null. The model clips itself: --model.clip_norm NORM"),
    ("gradient_clip_algorithm", "value", "is value, expected null. The model clips by norm: --model.clip_norm NORM"),
    ("default_root_dir", "there", "is there, expected null. Name the run folder: --run_dir DIR"),
    ("barebones", "true", "is True, expected false. Write less with --trainer.logger false"),
    ("val_check_interval", "00:00:01:00", "is 00:00:01:00, expected a number of updates, or a fraction of an epoch."),
    ("model_registry", "mine", "is mine, expected null. It is for the checkpoints of Lightning's own callback"),
]
REFUSED_BY_LIGHTNING = [
    ("accelerator", "tpu", "Requirement 'torch_xla>=1.13' not met"),
    ("val_check_interval", "9", "`val_check_interval` (9) must be less than or equal to the number of the training"),
    ("profiler", "fast", "it can only be one of ['simple', 'advanced', 'pytorch', 'xla']"),
]


def same(run, plain):
    """The same weights as those of a training without the argument."""
    state, expected = (read_checkpoint(RunFolder(folder).checkpoint)["state_dict"] for folder in (run, plain))
    return all(torch.equal(state[name], expected[name]) for name in expected)


def updates(number):
    return lambda run, _: read_checkpoint(RunFolder(run).checkpoint)["global_step"] == number


def validations(*expected):
    """The updates after which a validation was logged."""
    return lambda run, _: [*read_metrics(run)["val/kl"].dropna().index] == [*expected]


def logged(*expected):
    """The updates that were logged."""
    return lambda run, _: [*read_metrics(run)["train/kl"].dropna().index] == [*expected]


def without(file):
    return lambda run, _: not (Path(run) / file).exists()


SAME = [  # what changes no weight: as many at once as Lightning accepts
    {
        "accelerator": "cpu",
        "devices": "1",
        "strategy": "auto",
        "num_nodes": "1",
        "precision": "32-true",
        "min_epochs": "1",  # of a training that a callback may stop before
        "min_steps": "1",
        "max_time": "00:01:00:00",
        "limit_test_batches": "1",
        "limit_predict_batches": "1",
        "num_sanity_val_steps": "0",
        "deterministic": "warn",
        "benchmark": "false",
        "inference_mode": "false",
        "use_distributed_sampler": "false",  # there is one device
        "detect_anomaly": "true",
        "sync_batchnorm": "true",
        "reload_dataloaders_every_n_epochs": "1",
        "enable_autolog_hparams": "false",
    },
    {"plugins": "TorchSyncBatchNorm"},
]
WORKS = [  # each trains two epochs of five updates
    ("precision", "bf16-mixed", lambda run, plain: not same(run, plain)),
    ("logger", "false", without("metrics.jsonl")),
    ("callbacks", "LearningRateMonitor", lambda run, _: "lr-Adam" in read_metrics(run)),
    ("fast_dev_run", "2", without("checkpoints")),
    ("max_epochs", "1", updates(5)),
    ("max_steps", "7", updates(7)),
    ("max_time", "00:00:00:00", without("checkpoints")),
    ("limit_train_batches", "3", updates(6)),
    ("limit_train_batches", "0.4", updates(4)),
    ("limit_val_batches", "0", lambda run, _: "val/kl" not in read_metrics(run)),
    ("overfit_batches", "2", updates(4)),
    ("val_check_interval", "2", validations(2, 4, 7, 9)),
    ("check_val_every_n_epoch", "2", validations(10)),
    ("log_every_n_steps", "7", logged(7)),  # more than an epoch has, of which Lightning warns
    ("enable_checkpointing", "false", without("checkpoints")),
    ("accumulate_grad_batches", "5", updates(2)),
]
PRINTS = [
    ("enable_progress_bar", "true", "epoch 2/2"),
    ("enable_model_summary", "true", "Trainable params"),
    ("profiler", "simple", "FIT Profiler Report"),
]


def test_the_lists_have_every_argument_of_the_trainer():
    listed = {argument for argument, *_ in (*REFUSED, *REFUSED_BY_LIGHTNING, *WORKS, *PRINTS)}

    assert listed.union(*SAME) == set(inspect.signature(Trainer).parameters)


@pytest.mark.parametrize(("argument", "value", "sentence"), REFUSED)
def test_what_would_not_do_what_it_says_is_refused(argument, value, sentence, tiny_config, in_tmp_path, capsys):
    status = main(["fit", "--config", str(tiny_config), f"--trainer.{argument}", value])

    assert status == 2
    assert capsys.readouterr().err.startswith(f"forbes: trainer.{argument}: {sentence}")
    assert list(in_tmp_path.iterdir()) == []


@pytest.mark.parametrize(("argument", "value", "sentence"), REFUSED_BY_LIGHTNING)
def test_what_lightning_refuses_is_one_sentence(argument, value, sentence, tiny_config, in_tmp_path, capsys):
    assert main(["fit", "--config", str(tiny_config), f"--trainer.{argument}", value]) == 2

    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("argument", "value", "holds"), WORKS)
def test_what_is_accepted_does_what_it_says(argument, value, holds, tiny_config, tiny_run, tmp_path, recwarn):
    run = tmp_path / "run"

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run), f"--trainer.{argument}", value]) == 0

    assert holds(run, tiny_run)
    assert not [warning for warning in recwarn if "lightning" in warning.filename]


@pytest.fixture
def any_algorithm():
    """Allow them again, after `deterministic`."""
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("arguments", SAME)
def test_what_does_not_concern_the_updates_changes_no_weight(
    arguments, tiny_config, tiny_run, tmp_path, recwarn, any_algorithm
):
    flags = [f"--trainer.{argument}={value}" for argument, value in arguments.items()]

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run"), *flags]) == 0

    assert same(tmp_path / "run", tiny_run)
    assert not [warning for warning in recwarn if "lightning" in warning.filename]


@contextmanager
def logged_to_stdout():
    """Lightning's own handler writes to what stderr was when it was imported."""
    handler = logging.StreamHandler(sys.stdout)
    logging.getLogger("lightning.pytorch").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("lightning.pytorch").removeHandler(handler)


@pytest.mark.parametrize(("argument", "value", "text"), PRINTS)
def test_what_is_to_be_printed_is_printed(argument, value, text, tiny_config, in_tmp_path, capsys):
    with logged_to_stdout():
        assert main(["fit", "--config", str(tiny_config), f"--trainer.{argument}", value]) == 0

    assert text in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argument", "batches"), [("accumulate_grad_batches", [*range(10)]), ("overfit_batches", [0, 1, 0, 1])]
)
def test_no_two_batches_share_their_noise(argument, batches, tiny_config, in_tmp_path, monkeypatch):
    """Batches are drawn again only where `overfit_batches` asks for it."""
    drawn, noises = [], []
    train_index, derive_seed = SequenceDataModule.train_index, seeded.derive_seed

    def draw(self, number):
        drawn.append(number)
        return train_index(self, number)

    def derive(seed, purpose, counter):
        noises.extend([counter] if purpose == "update" else [])
        return derive_seed(seed, purpose, counter)

    monkeypatch.setattr(SequenceDataModule, "train_index", draw)
    monkeypatch.setattr(seeded, "derive_seed", derive)
    assert main(["fit", "--config", str(tiny_config), f"--trainer.{argument}", "2"]) == 0

    assert drawn == batches
    assert noises == [*range(len(batches))]


@pytest.mark.parametrize(
    ("argument", "value", "sentence"),
    [
        ("max_steps", "7", "is 7, expected -1. An agent trains in whole epochs, each with an episode of its own"),
        ("max_time", "00:01:00:00", "expected null. An agent trains in whole epochs"),
        ("overfit_batches", "2", "is 2, expected 0. The replay of an agent grows during training"),
    ],
)
def test_an_agent_trains_in_whole_epochs(argument, value, sentence, in_tmp_path, capsys):
    config = str(Path(__file__).parents[2] / "configs" / "pomdp" / "mountain_hike" / "agent_forbes.yaml")

    assert main(["fit", "--config", config, f"--trainer.{argument}", value]) == 2

    assert sentence in capsys.readouterr().err


def test_the_loops_of_a_trained_model_print_what_they_find(tiny_run, in_tmp_path, capsys):
    trained = ["--config", f"{tiny_run}/config.yaml", "--ckpt_path", f"{tiny_run}/checkpoints/last.ckpt"]

    for command, split in (("validate", "val"), ("test", "test")):
        assert main([command, *trained]) == 0
        assert f"{split}/elbo[bernoulli,S=1]  -" in capsys.readouterr().out  # with likelihood and samples
    assert main(["predict", *trained]) == 0

    bounds = [float(line) for line in capsys.readouterr().out.splitlines()]
    assert len(bounds) == 12
    assert all(bound < 0 for bound in bounds)
