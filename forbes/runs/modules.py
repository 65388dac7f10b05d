"""Build the model and the data of a run's configuration, and load the weights of a checkpoint."""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from jsonargparse import Namespace
from lightning import LightningModule
from lightning.pytorch.cli import LightningArgumentParser
from torch import Tensor, nn

from forbes.data import Experience, SequenceDataModule
from forbes.errors import ForbesError
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.config_errors import building, one_sentence
from forbes.runs.configs import find_config
from forbes.runs.configuration import (
    allow_modules,
    changed_defaults,
    data_parser,
    data_paths,
    experiment_parser,
    require_classes,
)
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.hyperparameters import build_arguments, plain_arguments

__all__ = ["LoadedRun", "build_data", "build_run", "check_weights", "load_module", "open_module", "weights_of"]

Module = TypeVar("Module", bound=LightningModule)


class LoadedRun(NamedTuple, Generic[Module]):
    """A loaded run, consistent even if a training replaces the files afterwards."""

    module: Module
    """Module on the CPU in evaluation mode."""
    data: SequenceDataModule
    config: dict[str, Any]
    """Content of config.yaml."""
    checkpoint: str
    """SHA-256 of the checkpoint from which the weights were loaded, for records of evaluations."""


def load_module(checkpoint: Path, kind: type[Module], arguments: Mapping[str, Any]) -> Module:
    """Load a module from a checkpoint, on the CPU. `WorldModel.load_from_checkpoint` calls this.

    Args:
        checkpoint: checkpoint in a run folder, `RUN/checkpoints/NAME.ckpt`, or one of a plain `Trainer`.
        kind: class of the module.
        arguments: constructor arguments that replace those used in training.
    """
    if RunFolder(checkpoint).config.is_file():
        changes = {f"model.init_args.{name}": value for name, value in arguments.items()}
        return open_module(checkpoint, kind, "forbes beliefs", changes).module
    content = open_checkpoint(checkpoint).content
    state = weights_of(content, str(checkpoint))
    saved = content.get("hyper_parameters", {})
    if not isinstance(saved, dict):
        raise ForbesError(
            f"{checkpoint}: its hyper_parameters are a {type(saved).__name__}, expected arguments by name. Take another"
        )
    saved = {name: value for name, value in saved.items() if name not in arguments}
    module = kind(**build_arguments(kind, saved, str(checkpoint)), **arguments)
    check_weights(module, state, str(checkpoint))
    module.load_state_dict(state)
    module.save_hyperparameters(saved | plain_arguments(arguments))
    return module


def open_module(run: Path | str, kind: type[Module], other: str, changes: Mapping[str, Any] = {}) -> LoadedRun[Module]:
    """Load the module of a run, on the CPU in evaluation mode.

    Args:
        run: run folder, for its last checkpoint, or a checkpoint in it.
        kind: class of the module.
        other: command for runs of another class, for the error message.
        changes: values that replace those of config.yaml, by key.

    Raises:
        ForbesError: if the module is of another class, or its weights do not fit.
    """
    folder = RunFolder.trained(run)
    checkpoint = open_checkpoint(folder.checkpoint)
    state = weights_of(checkpoint.content, str(folder.checkpoint))
    module, data, config = build_run(folder, changes)
    if not isinstance(module, kind):
        found = type(module).__name__
        raise ForbesError(f"{run}: a run of {found}, expected one of {kind.__name__}. Use instead: {other} {run}")
    check_weights(module, state, str(folder.checkpoint))
    module.load_state_dict(state)
    return LoadedRun(module.eval(), data, config, checkpoint.sha256)


def build_run(
    folder: RunFolder, changes: Mapping[str, Any] = {}
) -> tuple[LightningModule, SequenceDataModule, dict[str, Any]]:
    """Build the module, with untrained weights, and the data of a run, and return them with the configuration.

    Args:
        folder: run folder.
        changes: values that replace those of config.yaml, by key, e.g. `model.init_args.learning_rate`.

    Raises:
        ForbesError: if the configuration cannot be instantiated, or its data do not exist.
    """
    config = read_config(folder.config)
    for key, value in {**changed_defaults(config), **changes}.items():
        _put(config, key, value)
    sections: dict[str, Any] = {key: config[key] for key in ("seed_everything", "model", "data") if key in config}
    parser = experiment_parser()
    parsed = _parse(parser, sections, folder.config)
    with building(str(folder.config)):
        built = parser.instantiate(parsed, instantiators=[(partial(_recalled, folder.path), Experience, True)])
    return built.model, built.data, config


def build_data(where: str) -> SequenceDataModule:
    """Build the data of a run or of a configuration, without its model.

    Args:
        where: run folder, `pretrained:NAME`, or the name or file of a configuration.

    Raises:
        ForbesError: if there is no such thing, or its data do not exist.
    """
    folder = RunFolder(where)
    is_run = folder.config.is_file()
    file = folder.config if is_run else find_config(where)
    config = read_config(file, ("data",))
    for key, value in changed_defaults(config).items() if is_run else ():
        _put(config, key, value)
    parser = data_parser()
    parsed = _parse(parser, {"data": config["data"]}, file)
    with building(str(file)):
        built = parser.instantiate(parsed, instantiators=[(partial(_recalled, folder.path), Experience, True)])
    data: SequenceDataModule = built.data
    return data


def _parse(parser: LightningArgumentParser, sections: Mapping[str, Any], file: Path) -> Namespace:
    """Parse sections of a configuration; refuse classes that are not allowed, and data that do not exist."""
    allow_modules()
    try:
        with building(str(file)):
            parsed: Namespace = parser.parse_object(dict(sections))
    except argparse.ArgumentError as error:
        raise ForbesError(f"{file}: {one_sentence(str(error))}") from error
    try:
        require_classes(parsed)
    except ForbesError as error:
        raise ForbesError(f"{file}: {error}") from error
    for key, path in data_paths(parsed["data"]).items():
        if not Path(path).exists():
            name = "data." + key.replace("init_args.", "")
            raise ForbesError(f"{file}: {name} is {path}, which does not exist. Set it to the path of the data")
    return parsed


def _recalled(run: Path, kind: type[Experience], **arguments: Any) -> Experience:
    """Build the source of an agent's run with the stored shapes, so that no environment has to be started."""
    source = kind(**arguments)
    source.recall(run / "episodes")
    return source


def _put(config: dict[str, Any], key: str, value: Any) -> None:
    """Set the value of a dotted key `a.b.c` in nested sections."""
    *sections, last = key.split(".")
    for name in sections:
        config = config.setdefault(name, {})
    config[last] = value


def weights_of(content: Any, name: str) -> dict[str, Tensor]:
    """Return the weights in a checkpoint.

    Raises:
        ForbesError: if it is not the checkpoint of a training.
    """
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(values, Tensor) for values in state.values()):
        raise ForbesError(f"{name}: has no state_dict of tensors, expected that of a training. Take another one")
    if not isinstance(content.get("global_step"), int):
        raise ForbesError(f"{name}: has no global_step, expected the checkpoint of a training")
    return state


def check_weights(model: nn.Module, state: Mapping[str, Tensor], name: str) -> None:
    """Check that the tensors of a checkpoint fit a model.

    Raises:
        ForbesError: for the first tensor that is missing in one of them, or has another shape.
    """
    expected = model.state_dict()
    for key in (*expected, *state):
        if key not in state:
            problem = f"it has no {key}, which the configured model has: another belief family"
        elif key not in expected:
            problem = f"its {key} is not in the configured model: another belief family"
        elif expected[key].shape != state[key].shape:
            shapes = f"{tuple(state[key].shape)}, that of the configured model {tuple(expected[key].shape)}"
            problem = f"its {key} is {shapes}: other sizes, or observations or actions of another shape"
        else:
            continue
        raise ForbesError(f"{name}: {problem}. Use it with the configuration it was trained with")
