"""Build the model and the data of a run's configuration, and load the weights of a checkpoint."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from lightning import LightningModule

from forbes.data import SequenceDataModule
from forbes.errors import ForbesError
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.configs import find_config
from forbes.runs.configuration import changed_defaults, data_parser, experiment_parser
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.hyperparameters import build_arguments, plain_arguments
from forbes.runs.worlds import check_weights, instantiate, put, weights_of

__all__ = ["LoadedRun", "build_data", "build_module", "build_run", "load_module", "open_module"]

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
    module, data, config = build_module(folder, kind, other, changes)
    check_weights(module, state, str(folder.checkpoint))
    module.load_state_dict(state)
    return LoadedRun(module.eval(), data, config, checkpoint.sha256)


def build_module(
    folder: RunFolder, kind: type[Module], other: str, changes: Mapping[str, Any] = {}
) -> tuple[Module, SequenceDataModule, dict[str, Any]]:
    """Build the module of a run, with untrained weights, as `build_run`.

    Raises:
        ForbesError: if the module is of another class; `other` is the command for it.
    """
    module, data, config = build_run(folder, changes)
    if not isinstance(module, kind):
        found = type(module).__name__
        raise ForbesError(f"{folder}: a run of {found}, expected one of {kind.__name__}. Use instead: {other} {folder}")
    return module, data, config


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
        put(config, key, value)
    sections: dict[str, Any] = {key: config[key] for key in ("seed_everything", "model", "data") if key in config}
    built = instantiate(experiment_parser(), sections, folder.config, folder.path)
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
        put(config, key, value)
    data: SequenceDataModule = instantiate(data_parser(), {"data": config["data"]}, file, folder.path).data
    return data
