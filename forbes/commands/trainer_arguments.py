"""Refuse arguments of Lightning's Trainer that would have no effect here, or another effect than documented."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

from jsonargparse import Namespace
from lightning import LightningModule
from lightning.pytorch.plugins import Precision

from forbes.data import Experience, SequenceDataModule
from forbes.errors import ForbesError
from forbes.training.world_model import WorldModel

__all__ = ["require_usable"]


class _Rule(NamedTuple):
    """Accepted values of an argument, as a function and in words."""

    argument: str
    accepts: Callable[[Any], bool]
    expected: str


def _one_device(devices: Any) -> bool:
    """Return whether this is one device on every machine: the number 1, or one index as `3,` or `[3]`."""
    return re.fullmatch(r"1|\d+,|\[\d+\]", str(devices)) is not None


def _no_precision(plugins: Any) -> bool:
    listed = plugins if isinstance(plugins, list) else [plugins]
    return not any(isinstance(plugin, Precision) for plugin in listed)


_DEVICE = "A training uses one device"
_WHOLE_EPOCHS = "An agent trains in whole epochs, each with an episode of its own. Set --trainer.max_epochs"
_ALWAYS = (
    _Rule("devices", _one_device, f"1, or the index of one as [0]. {_DEVICE}"),
    _Rule("num_nodes", lambda nodes: nodes == 1, f"1. {_DEVICE}"),
    _Rule("strategy", lambda strategy: strategy == "auto", f"auto. {_DEVICE}"),
    _Rule(
        "precision",
        lambda precision: str(precision) in ("None", "32", "32-true", "bf16", "bf16-mixed"),
        "32-true or bf16-mixed. Densities and the recurrence are computed in float32",
    ),
    _Rule("plugins", _no_precision, "none of precision. Set --trainer.precision"),
    _Rule("default_root_dir", lambda folder: folder is None, "null. Name the run folder: --run_dir DIR"),
    _Rule(
        "barebones",
        lambda barebones: not barebones,
        "false. Write less with --trainer.logger false --trainer.enable_checkpointing false",
    ),
    _Rule("model_registry", lambda name: name is None, "null. It is for the checkpoints of Lightning's own callback"),
)
_OF_A_WORLD_MODEL = (
    _Rule("gradient_clip_val", lambda norm: norm is None, "null. The model clips itself: --model.clip_norm NORM"),
    _Rule(
        "gradient_clip_algorithm", lambda name: name is None, "null. The model clips by norm: --model.clip_norm NORM"
    ),
)
_OF_AN_AGENT = (
    _Rule("max_steps", lambda steps: steps == -1, f"-1. {_WHOLE_EPOCHS}"),
    _Rule("max_time", lambda duration: duration is None, f"null. {_WHOLE_EPOCHS}"),
    _Rule("overfit_batches", lambda share: not share, "0. The replay of an agent grows during training"),
)


def require_usable(trainer: Namespace, model: LightningModule, data: SequenceDataModule) -> None:
    """Refuse arguments of the Trainer that would not have their documented effect.

    Args:
        trainer: section `trainer` of the configuration, with its classes instantiated.
        model: module to train.
        data: data module.

    Raises:
        ForbesError: for the first refused argument.
    """
    rules = list(_ALWAYS)
    rules += _OF_A_WORLD_MODEL if isinstance(model, WorldModel) else ()
    rules += _OF_AN_AGENT if isinstance(data.source, Experience) else ()
    for rule in rules:
        if not rule.accepts(value := trainer[rule.argument]):
            found = type(value).__name__ if rule.argument == "plugins" else value
            raise ForbesError(f"trainer.{rule.argument}: is {found}, expected {rule.expected}")
