"""What a configuration may name and what is linked to what; how a run's configuration becomes a model and its data."""

import importlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from jsonargparse import set_parsing_settings
from lightning import LightningModule
from lightning.pytorch.cli import LightningArgumentParser

from forbes.data import SequenceDataModule
from forbes.errors import ForbesError

__all__ = ["add_links", "add_seed", "allow_modules", "allowed_modules", "changed_defaults", "experiment_parser"]

TRUSTED = ("forbes", "lightning", "torch")
_allowed: dict[str, None] = {}  # in their order, as long as the process lives: jsonargparse keeps them too


def allow_modules(names: Sequence[str] = ()) -> None:
    """Let configurations name classes of this package, Lightning, torch and the given modules, nothing else.

    A configuration may come from anywhere, and to name a class is to import, hence to run, its module. A given module
    is imported, from the working directory or as installed, so that its classes are known by their short names.

    Raises:
        ForbesError: when a given module does not exist.
    """
    if names and "" not in sys.path:
        sys.path.append("")
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise ForbesError(f"--allow-module {name}: {error}. Name an installed one or one of this folder") from error
    _allowed.update(dict.fromkeys(names))
    set_parsing_settings(import_path_denylist=["*"], import_path_allowlist=[*TRUSTED, *names])


def allowed_modules() -> list[str]:
    """Give the flags that let another process name the classes of the same modules."""
    return [part for name in _allowed for part in ("--allow-module", name)]


def add_seed(parser: LightningArgumentParser) -> None:
    """Add the one seed of an experiment."""
    parser.add_argument(
        "--seed_everything",
        type=int,
        default=0,
        help="seed of the weights, the noise, the order of the data and an agent's episodes",
    )


def add_links(parser: LightningArgumentParser) -> None:
    """Give the data's shapes, and whether its actions are discrete, to the model that asks, and the seed to both."""
    for name in ("observation_shape", "action_dim", "discrete"):
        parser.link_arguments(f"data.{name}", f"model.init_args.{name}", apply_on="instantiate")
    for part in ("model", "data"):
        parser.link_arguments("seed_everything", f"{part}.init_args.seed")


def changed_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return, by its key, what an older run did not write and had by a default that has changed since.

    Strokes were whole frames before `frames` could be chosen.
    """
    data = config.get("data")
    source = data.get("init_args", {}).get("source") if isinstance(data, dict) else None
    if not isinstance(source, dict) or not str(source.get("class_path")).endswith("Strokes"):
        return {}
    return {} if "frames" in source.get("init_args", {}) else {"data.init_args.source.init_args.frames": "whole"}


def experiment_parser() -> LightningArgumentParser:
    """Give a parser of what makes a model and its data, without the trainer."""
    parser = LightningArgumentParser(exit_on_error=False)
    add_seed(parser)
    parser.add_lightning_class_args(LightningModule, "model", subclass_mode=True)
    parser.add_lightning_class_args(SequenceDataModule, "data", subclass_mode=True)
    add_links(parser)
    return parser
