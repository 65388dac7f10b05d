"""Modules of a run: the model and the data of its configuration, with the weights of a checkpoint."""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from lightning import LightningModule
from torch import Tensor, nn

from forbes.data import Experience, SequenceDataModule
from forbes.errors import ForbesError
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.config_errors import building, one_sentence
from forbes.runs.configuration import (
    allow_modules,
    changed_defaults,
    data_paths,
    experiment_parser,
    require_classes,
)
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.hyperparameters import build_arguments, plain_arguments

__all__ = ["LoadedRun", "build_run", "check_weights", "load_module", "open_module", "weights_of"]

Module = TypeVar("Module", bound=LightningModule)


class LoadedRun(NamedTuple, Generic[Module]):
    """What was read of a run, all at one time: a training may go on, and write others over its files."""

    module: Module
    """On the CPU and in evaluation mode."""
    data: SequenceDataModule
    config: dict[str, Any]
    """config.yaml."""
    checkpoint: str
    """SHA-256 of the checkpoint that the weights were read from, for the record of what is measured."""


def load_module(checkpoint: Path, kind: type[Module], arguments: Mapping[str, Any]) -> Module:
    """Load a module from a checkpoint, on the CPU; see `WorldModel.load_from_checkpoint`.

    Args:
        checkpoint: in a run folder, `RUN/checkpoints/NAME.ckpt`, or elsewhere, of a plain `Trainer`.
        kind: class of the module.
        arguments: of its constructor, in the place of those it was trained with.
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
    """Load the module of a run, on the CPU and in evaluation mode.

    Args:
        run: its folder, for the last checkpoint, or a checkpoint in it.
        kind: class of the module.
        other: command for runs of another class, for an error.
        changes: as for `build_run`.

    Raises:
        ForbesError: where the module is of another class, or its weights do not fit.
    """
    folder = RunFolder.trained(run)
    checkpoint = open_checkpoint(folder.checkpoint)
    state = weights_of(checkpoint.content, str(folder.checkpoint))
    module, data, config = build_run(folder, changes)
    if not isinstance(module, kind):
        found = type(module).__name__
        raise ForbesError(f"{run}: a run of {found}, expected one of {kind.__name__}. Measure it with: {other} {run}")
    check_weights(module, state, str(folder.checkpoint))
    module.load_state_dict(state)
    return LoadedRun(module.eval(), data, config, checkpoint.sha256)


def build_run(
    folder: RunFolder, changes: Mapping[str, Any] = {}
) -> tuple[LightningModule, SequenceDataModule, dict[str, Any]]:
    """Build the module and the data of a run's config.yaml, and return them with it; the weights are untrained.

    Args:
        folder: of the run.
        changes: values that replace those of config.yaml, by their keys, such as `model.init_args.learning_rate`.

    Raises:
        ForbesError: where the configuration cannot be built, or its data are not there.
    """
    config = read_config(folder.config)
    for key, value in {**changed_defaults(config), **changes}.items():
        _put(config, key, value)
    allow_modules()
    parser = experiment_parser()
    sections = {key: config[key] for key in ("seed_everything", "model", "data") if key in config}
    try:
        with building(str(folder.config)):
            parsed = parser.parse_object(sections)
    except argparse.ArgumentError as error:
        raise ForbesError(f"{folder.config}: {one_sentence(str(error))}") from error
    try:
        require_classes(parsed)
    except ForbesError as error:
        raise ForbesError(f"{folder.config}: {error}") from error
    for key, path in data_paths(parsed["data"]).items():
        if not Path(path).exists():
            name = "data." + key.replace("init_args.", "")
            raise ForbesError(f"{folder.config}: {name} is {path}, which is not there. Set it to where the data are")
    with building(str(folder.config)):
        built = parser.instantiate(parsed, instantiators=[(partial(_recalled, folder.path), Experience, True)])
    return built.model, built.data, config


def _recalled(run: Path, kind: type[Experience], **arguments: Any) -> Experience:
    """Build the source of an agent's run, with the shapes that the run has stored: no environment need start."""
    source = kind(**arguments)
    source.recall(run / "episodes")
    return source


def _put(config: dict[str, Any], key: str, value: Any) -> None:
    """Set `a.b.c` in nested sections."""
    *sections, last = key.split(".")
    for name in sections:
        config = config.setdefault(name, {})
    config[last] = value


def weights_of(content: Any, name: str) -> dict[str, Tensor]:
    """Return the weights in a checkpoint.

    Raises:
        ForbesError: where it is not the checkpoint of a training.
    """
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(values, Tensor) for values in state.values()):
        raise ForbesError(f"{name}: has no state_dict of tensors, expected that of a training. Take another one")
    if not isinstance(content.get("global_step"), int):
        raise ForbesError(f"{name}: does not say its global_step, expected the checkpoint of a training")
    return state


def check_weights(model: nn.Module, state: Mapping[str, Tensor], name: str) -> None:
    """Compare the tensors of a checkpoint with those of a model.

    Raises:
        ForbesError: naming the first tensor that only one of them has, or that has two shapes.
    """
    own = model.state_dict()
    for key in (*own, *state):
        if key not in state:
            problem = f"it has no {key}, which the configured model has: another belief family"
        elif key not in own:
            problem = f"its {key} is not in the configured model: another belief family"
        elif own[key].shape != state[key].shape:
            shapes = f"{tuple(state[key].shape)}, that of the configured model {tuple(own[key].shape)}"
            problem = f"its {key} is {shapes}: other sizes, or observations or actions of another shape"
        else:
            continue
        raise ForbesError(f"{name}: {problem}. Use it with the configuration it was trained with")
