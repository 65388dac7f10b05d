"""Which classes a configuration may use, the links between its arguments, and its parser."""

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace, set_parsing_settings
from torch import nn

import forbes
from forbes.data import SequenceData, SequenceSource
from forbes.errors import ForbesError
from forbes.models import Likelihood
from forbes.models.world import World
from forbes.pomdps import Process

if TYPE_CHECKING:
    from lightning.pytorch.cli import LightningArgumentParser

__all__ = ["add_links", "add_seed", "allow_modules", "allowed_modules", "changed_defaults", "data_paths"]
__all__ += ["data_parser", "experiment_parser", "plain_parser", "require_classes"]

_OF_FORBES = ("beliefs", "callbacks", "data", "models", "pomdps", "training")
_OF_LIGHTNING = ("accelerators", "callbacks", "loggers", "plugins", "profilers", "strategies")
TRUSTED = (
    *(f"forbes.{name}" for name in forbes.MODULES),
    *(f"forbes.{part}" for part in _OF_FORBES),
    *(f"lightning.pytorch.{part}" for part in _OF_LIGHTNING),
    "lightning.fabric.plugins",
)
"""Packages whose classes a configuration may use, and the public names of `import forbes`."""
_REFUSED = ("*",)  # everything else
FAMILIES: tuple[type, ...] = (nn.Module, Likelihood, SequenceData, SequenceSource, Process)
"""Base classes of the classes that a configuration may use, with those of Lightning."""
_BY_A_CLASS = "Use a class of forbes or Lightning, or one of your own with --allow-module MODULE"
_allowed: dict[str, None] = {}  # ordered; for the lifetime of the process, as in jsonargparse


def allow_modules(names: Sequence[str] = ()) -> None:
    """Restrict configurations to classes of `TRUSTED` and of the given modules.

    A configuration may come from an untrusted source, and using a class imports, hence runs, its module. The given
    modules are imported, from the working directory or as installed, so that their classes have short names. In
    arguments that accept any value, a class path remains a string. `require_classes` makes further checks.

    Raises:
        ForbesError: if a given module does not exist.
    """
    if names and "" not in sys.path:
        sys.path.append("")
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise ForbesError(f"--allow-module {name}: {error}. Name an installed one or one of this folder") from error
    _allowed.update(dict.fromkeys(names))
    set_parsing_settings(
        import_path_denylist=[*_REFUSED],
        import_path_allowlist=[*TRUSTED, *names],
        instantiate_subclass_spec_in_any=False,
    )


def allowed_modules() -> list[str]:
    """Return the flags that allow the same modules in another process."""
    return [part for name in _allowed for part in ("--allow-module", name)]


def require_classes(config: Any, key: str = "") -> None:
    """Refuse a parsed configuration that would call anything but a class of `_families` or of an allowed module.

    jsonargparse checks classes against the type of a parameter. But if the parameter is a Callable, it calls any
    function with the arguments of the configuration. A function of an allowed module may be given by name only.

    Args:
        config: configuration as parsed by jsonargparse, before instantiation, or a part of it.
        key: key of the part.

    Raises:
        ForbesError: for the first refused name.
    """
    if isinstance(config, Namespace):
        config = vars(config)
    if isinstance(config, Mapping):
        if "class_path" in config:
            _require_class(str(config["class_path"]), key)
        for name, value in config.items():
            require_classes(value, key if name == "init_args" else f"{key}.{name}".removeprefix("."))
    elif isinstance(config, list | tuple | set | frozenset):
        for value in config:
            require_classes(value, key)
    elif not callable(config) or isinstance(config, os.PathLike):  # a path of a file from which a part was read
        return
    elif not _is_allowed(getattr(config, "__module__", None)):
        raise ForbesError(f"{key}: is a {type(config).__name__}, expected a class. {_BY_A_CLASS}")


def _require_class(path: str, key: str) -> None:
    """Refuse a path that is not an allowed class; parsing has already imported it."""
    module, _, name = path.rpartition(".")
    kind = getattr(sys.modules.get(module), name, None)
    if not isinstance(kind, type) or not (issubclass(kind, _families()) or _is_allowed(kind.__module__)):
        raise ForbesError(f"{key}: {path} is not a class that fits here. {_BY_A_CLASS}")


def _families() -> tuple[type, ...]:
    """Return the base classes of the classes that a configuration may use.

    Before Lightning is imported, no class can be derived from one of Lightning's.
    """
    if "lightning" not in sys.modules:
        return FAMILIES
    from lightning import Callback, LightningDataModule
    from lightning.fabric.plugins import CheckpointIO, ClusterEnvironment, Precision
    from lightning.pytorch.accelerators import Accelerator
    from lightning.pytorch.loggers import Logger
    from lightning.pytorch.plugins import LayerSync
    from lightning.pytorch.profilers import Profiler
    from lightning.pytorch.strategies import Strategy

    plugins = (Accelerator, CheckpointIO, ClusterEnvironment, LayerSync, Precision, Strategy)
    return (*FAMILIES, LightningDataModule, Callback, Logger, Profiler, *plugins)


def _is_allowed(module: str | None) -> bool:
    """Return whether a module, or a package that contains it, was given to `allow_modules`."""
    return any(f"{module}.".startswith(f"{name}.") for name in _allowed)


def add_seed(parser: ArgumentParser) -> None:
    """Add the random seed of an experiment."""
    parser.add_argument(
        "--seed_everything",
        type=int,
        default=0,
        help="random seed for weights, noise, order of the data and an agent's episodes",
    )


def add_links(parser: ArgumentParser) -> None:
    """Link the data's shapes and kind of actions to the model's arguments, and the seed to both."""
    for name in ("observation_shape", "action_dim", "discrete"):
        parser.link_arguments(f"data.{name}", f"model.init_args.{name}", apply_on="instantiate")
    for part in ("model", "data"):
        parser.link_arguments("seed_everything", f"{part}.init_args.seed")


def changed_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values, by key, that an older run had by a default that has changed since.

    Strokes were whole frames before the argument `frames` existed.
    """
    data = config.get("data")
    source = data.get("init_args", {}).get("source") if isinstance(data, dict) else None
    if not isinstance(source, dict) or not str(source.get("class_path")).endswith("Strokes"):
        return {}
    return {} if "frames" in source.get("init_args", {}) else {"data.init_args.source.init_args.frames": "whole"}


def data_paths(data: Namespace) -> dict[str, str]:
    """Return the files and folders in the section `data`, by key: all arguments called `path`."""
    return {key: value for key, value in data.items() if key.split(".")[-1] == "path" and isinstance(value, str)}


def experiment_parser() -> "LightningArgumentParser":
    """Return a parser for model and data, without the trainer."""
    from lightning import LightningModule
    from lightning.pytorch.cli import LightningArgumentParser

    from forbes.data.datamodule import SequenceDataModule

    parser = LightningArgumentParser(exit_on_error=False)
    add_seed(parser)
    parser.add_lightning_class_args(LightningModule, "model", subclass_mode=True)
    parser.add_lightning_class_args(SequenceDataModule, "data", subclass_mode=True)
    add_links(parser)
    return parser


def data_parser() -> "LightningArgumentParser":
    """Return a parser for the data alone."""
    from lightning.pytorch.cli import LightningArgumentParser

    from forbes.data.datamodule import SequenceDataModule

    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_lightning_class_args(SequenceDataModule, "data", subclass_mode=True)
    return parser


def plain_parser() -> ArgumentParser:
    """Return a parser for the arguments of a `WorldModel` and a `SequenceDataModule`, without Lightning."""
    parser = ArgumentParser(exit_on_error=False)
    add_seed(parser)
    parser.add_class_arguments(World, "model.init_args", fail_untyped=False)
    parser.add_class_arguments(SequenceData, "data.init_args", fail_untyped=False)
    for name in ("observation_shape", "action_dim"):
        parser.link_arguments(f"data.init_args.{name}", f"model.init_args.{name}", apply_on="instantiate")
    for part in ("model", "data"):
        parser.link_arguments("seed_everything", f"{part}.init_args.seed")
    return parser
