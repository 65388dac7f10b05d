"""What a command imports before it does its work: no Trainer for an evaluation, nothing heavy for a wrong name."""

import inspect
import shutil
import subprocess
import sys

import pytest
import torch

import forbes
from forbes.data import SequenceData
from forbes.evaluation.runs import open_model
from forbes.models.world import World
from forbes.runs.worlds import open_world

PRETRAINED = "pretrained:strokes-forbes"
TRAINER = {"lightning", "torch._dynamo", "torchmetrics", "scipy.signal"}
"""What takes most of the time to import: Lightning, and what it imports."""


def imported_by(folder, *arguments):
    """The modules that a command has imported at its end, and what it says on stderr."""
    program = f"""
import sys
from forbes.commands.cli import main
status = main({[*map(str, arguments)]!r})
print("MODULES", status, *sys.modules)
"""
    command = [sys.executable, "-W", "ignore", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=True)
    _, status, *modules = done.stdout.splitlines()[-1].split()
    return int(status), {*modules}, done.stderr


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (("evaluate", PRETRAINED, "--scores", "elbo", "--sequences", "2"), {*TRAINER, "pandas", "matplotlib"}),
        (("complete", PRETRAINED, "-o", "a.png", "--index", "0", "--samples", "1"), {*TRAINER, "pandas"}),
        (("figures", "predictions", "--runs", PRETRAINED, "-o", ".", "--index", "0", "--samples", "1"), TRAINER),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_command_on_a_world_model_imports_no_trainer(tmp_path, arguments, absent):
    status, modules, told = imported_by(tmp_path, *arguments)

    assert status == 0, told
    assert not absent & modules


@pytest.mark.parametrize(
    "arguments",
    [
        ("evaluate", "absent"),
        ("calibrate", "absent", "-o", "."),
        ("beliefs", "absent"),
        ("complete", "absent", "-o", "a.png"),
        ("rollout", "absent", "--video", "a.gif"),
        ("export", "absent"),
        ("fit", "absent"),
        ("fit", "--resume", "absent"),
    ],
    ids=" ".join,
)
def test_a_missing_run_or_configuration_is_told_without_torch(tmp_path, arguments):
    status, modules, told = imported_by(tmp_path, *arguments)

    assert status == 2
    assert "absent: no such" in told
    assert not {"torch", "pandas", "matplotlib", "jsonargparse"} & modules


def test_the_model_without_a_trainer_is_that_of_load_run():
    world, data = forbes.load_run(PRETRAINED)

    loaded = open_world(PRETRAINED)

    assert loaded is not None
    assert not loaded.model.training
    assert type(loaded.model) is type(world.model)
    assert str(loaded.model) == str(world.model)
    torch.testing.assert_close(loaded.model.state_dict(), world.model.state_dict(), rtol=0, atol=0)
    assert (str(loaded.data.source), loaded.data.length) == (str(data.source), data.length)
    batch, expected = (each.sequences("test", torch.arange(3)) for each in (loaded.data, data))
    assert all(map(torch.equal, batch, expected))


def test_an_error_of_the_configuration_is_explained_as_ever(tmp_path, tiny_run):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    assert open_world(run) is not None
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("learning_rate:", "lerning_rate:"))

    assert open_world(run) is None
    with pytest.raises(forbes.ForbesError, match=r"lerning_rate.*did you mean"):
        open_model(run)


@pytest.mark.parametrize(("plain", "trained"), [(World, forbes.WorldModel), (SequenceData, forbes.SequenceDataModule)])
def test_both_forms_have_the_same_arguments(plain, trained):
    """Help pages of a subclass take them from the first, those of the class itself from the second."""
    arguments, of_trained = (inspect.getdoc(kind).split("Args:")[1].split("Example:")[0] for kind in (plain, trained))

    assert inspect.signature(plain) == inspect.signature(trained)
    assert arguments.strip() == of_trained.strip()
