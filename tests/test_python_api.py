"""`import forbes`: what it gives, when it imports it, and the ten lines that train a model."""

import ast
import subprocess
import sys
import warnings
from pathlib import Path

import lightning
import pytest
import torch
import yaml
from lightning import Trainer

import forbes
from forbes.cli import main
from forbes.training.checkpoint import read_checkpoint
from forbes.training.defaults import defaults_for

ROOT = Path(forbes.__file__).parents[1]
NAMES = sorted(forbes.MODULES)


@pytest.fixture
def digits(strokes_file):
    """A few digits in small batches."""
    strokes = forbes.Strokes(path=str(strokes_file), validation=20)
    return forbes.SequenceDataModule(strokes, batch_size=4, length=6, updates_per_epoch=1, validation_sequences=4)


@pytest.fixture
def world(digits):
    """An untrained model of them."""
    torch.manual_seed(0)
    return forbes.WorldModel.for_data(digits, belief=forbes.FlowBelief.configured(layers=2, width=4), hidden_dim=8)


def plain_trainer(**arguments):
    return Trainer(
        **{"accelerator": "cpu", "logger": False, "enable_progress_bar": False, "enable_model_summary": False},
        **arguments,
    )


def fit(trainer, world, data):
    with warnings.catch_warnings():  # Lightning's, of data that need no workers
        warnings.simplefilter("ignore")
        trainer.fit(world, data)


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_can_be_imported(name):
    value = getattr(forbes, name)

    assert value.__name__ == name
    assert name in dir(forbes)


def test_importing_forbes_imports_nothing_heavy():
    program = (
        "import sys, forbes; dir(forbes); print(*{'torch', 'lightning', 'numpy', 'jsonargparse'} & {*sys.modules})"
    )

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == ""


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'forbes' has no attribute 'WorldModle'"):
        forbes.WorldModle  # noqa: B018


def test_type_checkers_are_told_the_same_names():
    stub = ast.parse((ROOT / "forbes" / "__init__.pyi").read_text())
    told = {
        alias.asname: node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name == alias.asname
    }

    assert told == forbes.MODULES


def test_ten_lines_of_python_train_a_model(digits, in_tmp_path):
    world = forbes.WorldModel.for_data(digits, belief=forbes.FlowBelief.configured(layers=3))
    before = {name: values.clone() for name, values in world.state_dict().items()}
    trainer = plain_trainer(max_epochs=2)

    fit(trainer, world, digits)

    assert trainer.global_step == 2
    assert trainer.callback_metrics[f"val/{world.objective_name}"].isfinite()
    assert len(world.model.posterior.flow.couplings) == 3
    assert not all(torch.equal(values, before[name]) for name, values in world.state_dict().items())


def test_python_and_the_command_line_train_alike(digits, strokes_file, in_tmp_path):
    digits.updates_per_epoch = 3
    small = {"batch_size": 4, "length": 6, "updates_per_epoch": 3, "validation_sequences": 4}
    flags = {"path": strokes_file, "validation": 20}
    flags = {f"source.{name}": value for name, value in flags.items()} | small
    command = ["fit", "--config", f"{ROOT}/configs/strokes/forbes.yaml", "--run_dir", "run", "--trainer.max_epochs=1"]
    command += ["--trainer.callbacks=null", "--trainer.accelerator=cpu", "--seed_everything=3"]
    assert main([*command, *(f"--data.{name}={value}" for name, value in flags.items())]) == 0

    lightning.seed_everything(3, verbose=False)
    digits.seed = 3
    world = forbes.WorldModel.for_data(digits)
    fit(plain_trainer(max_epochs=1), world, digits)

    trained = read_checkpoint(Path("run/checkpoints/last.ckpt"))["state_dict"]
    torch.testing.assert_close(dict(world.state_dict()), dict(trained), rtol=0, atol=0)


CONFIGURED = {
    "strokes/forbes": lambda: forbes.Strokes(),
    "strokes/whole/forbes": lambda: forbes.Strokes(frames="whole"),
    "pomdp/tiger/forbes": lambda: forbes.Simulated(forbes.Tiger()),
    "pomdp/ungm/forbes": lambda: forbes.Simulated(forbes.Ungm()),
}


def described(value):
    """A class with its options, or an object, as a configuration says it."""
    if callable(value):
        options = getattr(value, "keywords", {})
        return {"class_path": getattr(value, "func", value).__name__} | ({"init_args": options} if options else {})
    if isinstance(value, forbes.VectorNormal):
        return {"class_path": "VectorNormal", "init_args": {"std": value.std}}
    return value if isinstance(value, int | float | str) else {"class_path": type(value).__name__}


@pytest.mark.parametrize("name", CONFIGURED)
def test_a_model_for_data_is_that_of_their_configuration(name):
    config = yaml.safe_load((ROOT / "configs" / f"{name}.yaml").read_text())["model"]["init_args"]

    assert {key: described(value) for key, value in defaults_for(CONFIGURED[name]()).items()} == config


def test_images_of_another_source_have_the_defaults_of_the_class(digits):
    class Screens(forbes.data.SequenceSource):
        observation_shape, action_dim = (3, 16, 16), 2
        sha256 = size = gather = decode = None

    data = forbes.SequenceDataModule(Screens(), length=5)

    world = forbes.WorldModel.for_data(data, hidden_dim=8, state_dim=4)

    assert type(world.model.encoder) is forbes.ConvEncoder
    assert type(world.model.likelihood) is forbes.Normal
    assert world.model.action_dim == 2


def test_an_agent_for_data_knows_whether_actions_are_discrete():
    data = forbes.SequenceDataModule(forbes.Simulated(forbes.Tiger(), train=50), length=5)

    agent = forbes.ImaginationActorCritic.for_data(data, control_dim=8)

    assert agent.discrete
    assert agent.model.action_dim == 3
    assert type(agent.model.likelihood) is forbes.OneHot
