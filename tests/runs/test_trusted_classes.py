"""No configuration runs code: what it names is a class of a known family, and nothing else is called."""

import inspect
import re
import shutil
import typing
from argparse import ArgumentError
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import yaml
from jsonargparse import ArgumentParser
from jsonargparse._parameter_resolvers import get_signature_parameters
from lightning import LightningModule, Trainer

import forbes.callbacks  # noqa: F401  so that it is among what a configuration can reach
from forbes.commands.cli import main
from forbes.data import SequenceDataModule
from forbes.errors import ForbesError
from forbes.runs.configuration import TRUSTED, allow_modules, require_classes


def classes_in(hint):
    """List the classes that a type is made of, those that a Callable returns among them."""
    parts = typing.get_args(hint)
    if typing.get_origin(hint) is Callable:
        parts = parts[-1:]
    inner = [kind for part in parts for kind in classes_in(part)]
    return inner or ([hint] if inspect.isclass(hint) else [])


def descendants(kind):
    yield kind
    for child in type.__subclasses__(kind):
        yield from descendants(child)


@cache
def reachable_types():
    """List the types of all parameters that a YAML can reach: of the trainer, the model, the data and all in them."""
    types, seen = {}, set()
    pending = [LightningModule, SequenceDataModule, *(each.annotation for each in get_signature_parameters(Trainer))]
    while pending:
        hint = pending.pop()
        name = re.sub(" at 0x[0-9a-f]+", "", str(hint))  # the same in every process
        if name in types:
            continue
        types[name] = hint
        found = {child for each in classes_in(hint) for child in descendants(each)} - seen
        seen |= found
        ours = [kind for kind in found if str(kind.__module__).startswith(TRUSTED)]
        for kind in sorted(ours, key=str):
            if not issubclass(kind, BaseException):
                pending += [each.annotation for each in get_signature_parameters(kind)]
    return types


def parser_of(hint):
    """Make a parser of one part of a configuration, as `forbes` has it."""
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--part", type=hint)
    return parser


def build(parser, value):
    """Do what `forbes` does with a part of a configuration."""
    parsed = parser.parse_object({"part": value})
    require_classes(parsed)
    return parser.instantiate(parsed).part


@pytest.fixture
def mark(tmp_path):
    """A file that no configuration may make."""
    return tmp_path / "executed"


@pytest.fixture
def spy(monkeypatch):
    """A function of a trusted package that writes a file."""

    def spy(path: str):
        Path(path).touch()

    spy.__module__, spy.__qualname__ = "forbes.models.networks", "spy"
    monkeypatch.setattr("forbes.models.networks.spy", spy, raising=False)
    return spy


def attacks(mark):
    """List what a configuration may say to run a command, write a file, or call a function."""
    return [
        {"class_path": "torch.utils.collect_env.run", "init_args": {"command": f"touch {mark}"}},
        {"class_path": "torch.save", "init_args": {"obj": 1, "f": str(mark)}},
        {"class_path": "forbes.files.replace_file", "init_args": {"path": str(mark), "content": "!!binary eA=="}},
        {"class_path": "forbes.models.networks.spy", "init_args": {"path": str(mark)}},
        {"class_path": "forbes.data.episodes.store.EpisodeWriter", "init_args": {"path": str(mark)}},
    ]


def test_the_types_that_a_yaml_reaches_are_many():
    words = {word for name in reachable_types() for word in name.replace("[", ".").split(".")}

    assert {"Callable", "Any", "list", "dict"} <= words
    assert len(reachable_types()) > 150


def test_no_parameter_calls_a_function_of_the_yaml(mark, spy):
    allow_modules()
    called, tried = [], 0
    for name, hint in reachable_types().items():
        try:
            parser = parser_of(hint)
        except ValueError:  # a type that jsonargparse does not support
            continue
        tried += 1
        kinds = [kind for kind in classes_in(hint) if str(kind.__module__).startswith(TRUSTED)]
        for returned in [inspect.Signature.empty, *kinds]:
            spy.__annotations__["return"] = returned
            for attack in attacks(mark):
                for value in (attack, [attack], {"key": attack}, attack["class_path"]):
                    try:
                        build(parser, value)
                    except (ArgumentError, ForbesError, TypeError, ValueError):
                        pass
                    if mark.exists():
                        called.append((name, value))
                        mark.unlink()

    assert not called
    assert tried > 150


@pytest.mark.parametrize(("number", "place"), [*enumerate(["encoder", "decoder", "belief", "prior", "model"])])
def test_a_run_folder_that_somebody_sends_runs_nothing(tiny_run, tmp_path, mark, spy, capsys, place, number):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["model"]["init_args"][place] = attacks(mark)[number]
    (run / "config.yaml").write_text(yaml.safe_dump(config))

    for command in (["evaluate", str(run)], ["figures", "elbo", "--runs", str(run)], ["fit", "--resume", str(run)]):
        assert main(command) == 2
        assert f"model.{place}: " in capsys.readouterr().err
    assert main(["fit", "--config", str(run / "config.yaml"), "--run_dir", str(tmp_path / "new")]) == 2
    assert not mark.exists()


def test_a_file_that_a_configuration_includes_is_no_way_round(tiny_config, mark, spy, in_tmp_path):
    included = in_tmp_path / "included.yaml"
    config = yaml.safe_load(tiny_config.read_text())
    config["model"]["init_args"]["encoder"] = str(included)
    Path("sent.yaml").write_text(yaml.safe_dump(config))
    included.write_text("{class_path: MLPEncoder, init_args: {width: 8, layers: 1}}")
    assert main(["fit", "--config", "sent.yaml", "--trainer.max_epochs", "1"]) == 0

    for attack in attacks(mark):
        included.write_text(yaml.safe_dump(attack))
        assert main(["fit", "--config", "sent.yaml"]) == 2
        assert main(["fit", "--config", str(tiny_config), "--model.encoder", str(included)]) == 2

    assert not mark.exists()


def test_a_hubconf_in_the_folder_is_not_run(tiny_config, in_tmp_path, capsys):
    Path("hubconf.py").write_text("import pathlib\npathlib.Path('executed').touch()\ndef mine(): ...\n")
    load = {"class_path": "torch.hub.load", "init_args": {"repo_or_dir": ".", "model": "mine", "source": "local"}}
    config = yaml.safe_load(tiny_config.read_text())
    config["model"]["init_args"]["encoder"] = load
    Path("sent.yaml").write_text(yaml.safe_dump(config))

    assert main(["fit", "--config", "sent.yaml"]) == 2

    assert "model.encoder: torch.hub.load is not a class of forbes or Lightning" in capsys.readouterr().err
    assert not Path("executed").exists()


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("callbacks", {"class_path": "ModelCheckpoint", "init_args": {"save_top_k": 1}}),
        ("callbacks", [{"class_path": "lightning.pytorch.callbacks.EarlyStopping", "init_args": {"monitor": "x"}}]),
        ("callbacks", {"class_path": "RichProgressBar", "init_args": {"theme": {"metrics": "red"}}}),
        ("callbacks", {"class_path": "EMAWeightAveraging"}),
        ("callbacks", {"class_path": "Collect", "init_args": {"seed_episodes": 2}}),
        ("logger", {"class_path": "CSVLogger", "init_args": {"save_dir": "logs"}}),
        ("logger", [{"class_path": "lightning.pytorch.loggers.TensorBoardLogger", "init_args": {"save_dir": "logs"}}]),
        ("profiler", {"class_path": "SimpleProfiler"}),
        ("profiler", {"class_path": "PyTorchProfiler", "init_args": {"row_limit": 5}}),
        ("strategy", {"class_path": "DDPStrategy"}),
        ("accelerator", {"class_path": "CPUAccelerator"}),
        ("plugins", {"class_path": "AsyncCheckpointIO", "init_args": {"checkpoint_io": "TorchCheckpointIO"}}),
        ("plugins", {"class_path": "LightningEnvironment"}),
    ],
)
def test_the_classes_of_lightning_are_named_as_before(argument, value):
    allow_modules()
    (hint,) = [each.annotation for each in get_signature_parameters(Trainer) if each.name == argument]

    built = build(parser_of(hint), value)

    spec = value[0] if isinstance(value, list) else value
    (made,) = built if isinstance(built, list) else [built]
    assert type(made).__name__ == spec["class_path"].rpartition(".")[2]


def test_your_own_module_gives_classes_and_functions_by_name(in_tmp_path, monkeypatch):
    Path("of_mine.py").write_text(
        "from lightning import Callback\n"
        "class Part: ...\n"
        "class Mine(Callback):\n"
        "    def __init__(self, part: Part): self.part = part\n"
        "def size(batch): return 3\n"
        "def call(batch: int): open('executed', 'w')\n"
    )
    monkeypatch.syspath_prepend(str(in_tmp_path))
    allow_modules(["of_mine"])
    (hint,) = [each.annotation for each in get_signature_parameters(Trainer) if each.name == "callbacks"]

    mine = build(parser_of(hint), {"class_path": "of_mine.Mine", "init_args": {"part": {"class_path": "of_mine.Part"}}})
    monitor = build(
        parser_of(hint), {"class_path": "ThroughputMonitor", "init_args": {"batch_size_fn": "of_mine.size"}}
    )

    assert type(mine.part).__name__ == "Part"
    assert monitor.batch_size_fn(None) == 3
    called = {"class_path": "of_mine.call", "init_args": {"batch": 1}}
    with pytest.raises(ForbesError, match=r"batch_size_fn: of_mine\.call is not a class that fits here"):
        build(parser_of(hint), {"class_path": "ThroughputMonitor", "init_args": {"batch_size_fn": called}})
    assert not Path("executed").exists()
