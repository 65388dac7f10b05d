"""`import forbes`: what it gives, when it imports it, and the ten lines that train a model."""

import ast
import doctest
import inspect
import operator
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import lightning
import numpy as np
import pytest
import torch
import yaml
from lightning import Trainer

import forbes
from forbes.commands.cli import main
from forbes.runs.checkpoint import read_checkpoint
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
    heavy = {"torch", "lightning", "numpy", "jsonargparse", "mujoco"}
    program = f"import sys, forbes; dir(forbes); print(*{heavy} & {{*sys.modules}})"

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == ""


def test_the_command_of_a_training_imports_neither_the_control_suite_nor_pandas():
    """MuJoCo chooses its rendering when it is imported, and fails on a machine that has none."""
    program = "import sys, forbes.commands.fit; print(*{'dm_control', 'mujoco', 'OpenGL', 'pandas'} & {*sys.modules})"

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
    if isinstance(value, forbes.SymlogNormal | forbes.VectorNormal):
        return {"class_path": type(value).__name__, "init_args": {"std": value.std}}
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


@pytest.fixture
def trained(world, digits, in_tmp_path):
    """The checkpoint that a plain trainer leaves of it."""
    trainer = plain_trainer(max_epochs=1)
    fit(trainer, world, digits)
    trainer.save_checkpoint("plain.ckpt")
    return Path("plain.ckpt")


def same_weights(one, other):
    torch.testing.assert_close(dict(one.state_dict()), dict(other.state_dict()), rtol=0, atol=0)


def test_a_model_is_loaded_from_the_checkpoint_of_a_run(tiny_run):
    world = forbes.WorldModel.load_from_checkpoint(tiny_run / "checkpoints" / "last.ckpt")

    same_weights(world, forbes.load_run(tiny_run)[0])
    assert world.training
    assert (world.seed, world.learning_rate) == (0, 5e-4)


def test_arguments_take_the_place_of_those_of_a_run(tiny_run):
    checkpoint = tiny_run / "checkpoints" / "last.ckpt"

    assert forbes.WorldModel.load_from_checkpoint(checkpoint, learning_rate=1e-3).learning_rate == 1e-3
    with pytest.raises(forbes.ForbesError, match=r"config\.yaml: model\.learnin_rate: .*did you mean learning_rate\?"):
        forbes.WorldModel.load_from_checkpoint(checkpoint, learnin_rate=1e-3)
    with pytest.raises(forbes.ForbesError, match="a run of WorldModel, expected one of ImaginationActorCritic"):
        forbes.ImaginationActorCritic.load_from_checkpoint(checkpoint)


def test_a_model_is_loaded_from_a_plain_trainer_checkpoint(trained, world):
    loaded = forbes.WorldModel.load_from_checkpoint(trained)

    same_weights(loaded, world)
    assert type(loaded.model.likelihood) is forbes.OnePixel
    assert (loaded.kl_warmup, loaded.schedule, loaded.seed) == (500, "cosine", 0)


def test_arguments_of_any_kind_replace_a_plain_trainers(trained, digits, world):
    belief = forbes.FlowBelief.configured(layers=2, width=4, min_std=0.2)

    loaded = forbes.WorldModel.load_from_checkpoint(trained, belief=belief, warmup=7)

    same_weights(loaded, world)
    assert loaded.model.prior.base.min_std == 0.2
    assert loaded.warmup == 7


def test_a_plain_trainer_checkpoint_of_other_sizes_is_refused(trained):
    with pytest.raises(forbes.ForbesError, match=r"plain\.ckpt: its model\.\S+ is .*that of the configured model"):
        forbes.WorldModel.load_from_checkpoint(trained, hidden_dim=9)


def test_a_checkpoint_that_names_a_foreign_class_is_refused(trained):
    content = torch.load(trained, weights_only=True)
    content["hyper_parameters"]["belief"] = {"class_path": "subprocess.Popen", "init_args": {"args": ["true"]}}
    torch.save(content, trained)

    with pytest.raises(forbes.ForbesError, match=r"plain\.ckpt: model\.belief: subprocess\.Popen is not a class of"):
        forbes.WorldModel.load_from_checkpoint(trained)


def test_what_a_checkpoint_cannot_name_has_to_be_given_again(digits, tmp_path):
    def belief(state_dim, context_dim):
        return forbes.FlowBelief(state_dim, context_dim, layers=2, width=4)

    world = forbes.WorldModel.for_data(digits, belief=belief, hidden_dim=np.int64(8), learning_rate=np.float64(1e-3))
    content = {"state_dict": world.state_dict(), "global_step": 0, "hyper_parameters": dict(world.hparams)}
    torch.save(content, tmp_path / "x")

    with pytest.raises(forbes.ForbesError, match=r"x: model\.belief: "):
        forbes.WorldModel.load_from_checkpoint(tmp_path / "x")
    loaded = forbes.WorldModel.load_from_checkpoint(tmp_path / "x", belief=belief)
    same_weights(loaded, world)
    assert loaded.learning_rate == 1e-3


def test_checkpoint_arguments_that_are_no_mapping_are_refused(trained):
    torch.save(torch.load(trained, weights_only=True) | {"hyper_parameters": [1]}, trained)

    with pytest.raises(forbes.ForbesError, match=r"plain\.ckpt: its hyper_parameters are a list, expected"):
        forbes.WorldModel.load_from_checkpoint(trained)


def test_arguments_of_every_data_source_survive_a_checkpoint(tmp_path):
    for name, source in CONFIGURED.items():
        data = forbes.SequenceDataModule(source())
        world = forbes.WorldModel.for_data(data, model=forbes.ParticleModel.configured(particles=3), kl="monte_carlo")
        content = {"state_dict": world.state_dict(), "global_step": 0, "hyper_parameters": dict(world.hparams)}
        torch.save(content, tmp_path / "x")

        loaded = forbes.WorldModel.load_from_checkpoint(tmp_path / "x")

        same_weights(loaded, world)
        assert dict(loaded.hparams) == dict(world.hparams), name
        assert vars(loaded.model.likelihood) == vars(world.model.likelihood)
        assert (loaded.kl, loaded.model.particles) == ("monte_carlo", 3)


def test_the_signature_of_an_agent_has_every_option():
    agent = inspect.signature(forbes.ImaginationActorCritic).parameters
    world = inspect.signature(forbes.WorldModel).parameters

    assert [*agent][:2] == ["trajectories", "horizon"]
    assert {*world, "control_dim", "reward_std", "exploration"} < {*agent}
    assert all(agent[name].default == world[name].default for name in world)
    assert not [one for one in agent.values() if one.kind is inspect.Parameter.VAR_KEYWORD]


@pytest.mark.parametrize("kind", [forbes.ImaginationActorCritic, forbes.PlanningAgent])
def test_an_agent_takes_what_its_signature_says(kind):
    arguments = {name: one.default for name, one in inspect.signature(kind).parameters.items()}

    kind(**arguments | {"action_dim": 2, "hidden_dim": 8, "control_dim": 8})
    with pytest.raises(TypeError, match="unexpected keyword argument 'horizons'"):
        kind(action_dim=2, horizons=3)


@pytest.fixture(scope="module")
def workplace(tiny_run, tmp_path_factory):
    """A folder with what the examples read: a run, and episodes of a tiger."""
    folder = tmp_path_factory.mktemp("workplace")
    shutil.copytree(tiny_run, folder / "runs" / "forbes-0")
    assert main(["data", "collect", "--task", "tiger", "--episodes", "20", "-o", str(folder / "episodes/tiger")]) == 0
    return folder


@pytest.mark.parametrize("name", [*NAMES, "configured.Configurable"])
def test_the_example_of_a_public_name_gives_what_it_says(name, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    value = operator.attrgetter(name)(forbes)
    (example,) = doctest.DocTestFinder(recurse=False).find(value, name, globs={"forbes": forbes, "torch": torch})
    assert len(example.examples) > 0

    found = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)

    assert found.failed == 0
