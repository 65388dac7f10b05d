"""Load the world model of a run without Lightning, and what all loading shares: parsing, building and weights."""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from jsonargparse import ArgumentParser, Namespace
from torch import Tensor, nn

from forbes.data import Experience, SequenceData
from forbes.errors import ForbesError
from forbes.models import BeliefModel
from forbes.models.world import World
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.config_errors import building, one_sentence
from forbes.runs.configuration import allow_modules, changed_defaults, data_paths, plain_parser, require_classes
from forbes.runs.folder import RunFolder, read_config

__all__ = ["LoadedWorld", "build_world", "check_weights", "instantiate", "is_world", "open_world", "put", "weights_of"]

_OURS = {"model": "forbes.WorldModel", "data": "forbes.SequenceDataModule"}
"""Classes that are built without Lightning. Their subclasses may be trained by any other constructor."""


class LoadedWorld(NamedTuple):
    """The model and the data of a run, consistent even if a training replaces the files afterwards."""

    model: BeliefModel
    """Model on the CPU in evaluation mode."""
    data: SequenceData
    config: dict[str, Any]
    """Content of config.yaml."""
    checkpoint: str
    """SHA-256 of the checkpoint from which the weights were loaded, for records of evaluations."""


def open_world(run: Path | str) -> LoadedWorld | None:
    """Load the model of a run of `WorldModel` itself, on the CPU in evaluation mode, without Lightning.

    Returns:
        The loaded model; None for a run of another class, or of a configuration with an error. `open_module` loads the
        first and explains the second.

    Raises:
        ForbesError: if there is no trained run, or its weights do not fit.
    """
    folder = RunFolder.trained(run)
    config = read_config(folder.config)
    if not is_world(config):
        return None
    checkpoint = open_checkpoint(folder.checkpoint)
    state = weights_of(checkpoint.content, str(folder.checkpoint))
    for key, value in changed_defaults(config).items():
        put(config, key, value)
    try:
        world, data = build_world(config, folder.config, folder.path)
    except ForbesError:
        return None
    check_weights(world, state, str(folder.checkpoint))
    world.load_state_dict(state)
    return LoadedWorld(world.eval().model, data, config, checkpoint.sha256)


def build_world(config: Mapping[str, Any], file: Path, run: Path) -> tuple[World, SequenceData]:
    """Build the untrained model and the data of a complete configuration of a `WorldModel`; raises as `instantiate`."""
    sections = {name: {key: value for key, value in config[name].items() if key != "class_path"} for name in _OURS}
    if "seed_everything" in config:
        sections["seed_everything"] = config["seed_everything"]
    built = instantiate(plain_parser(), sections, file, run)
    return built.model.init_args, built.data.init_args


def is_world(config: Mapping[str, Any]) -> bool:
    """Return whether a config.yaml has the class `WorldModel` itself, and `SequenceDataModule` itself."""
    return all(config[name]["class_path"] == path for name, path in _OURS.items())


def instantiate(parser: ArgumentParser, sections: Mapping[str, Any], file: Path, run: Path) -> Namespace:
    """Build what sections of a configuration describe.

    Args:
        parser: parser of the sections.
        sections: their content.
        file: configuration that they are from, for error messages.
        run: run folder, from which an agent's source has its shapes, so that no environment has to be started.

    Raises:
        ForbesError: if a class is not allowed or cannot be built, or if data do not exist.
    """
    parsed = _parse(parser, sections, file)
    with building(str(file)):
        built: Namespace = parser.instantiate(parsed, instantiators=[(partial(_recalled, run), Experience, True)])
    return built


def _parse(parser: ArgumentParser, sections: Mapping[str, Any], file: Path) -> Namespace:
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


def put(config: dict[str, Any], key: str, value: Any) -> None:
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
