"""Refuse arguments of Lightning's Trainer that would have no effect here, or another effect than documented."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

from jsonargparse import Namespace
from lightning import LightningModule
from lightning.pytorch.plugins import Precision

from forbes.data import Experience, SequenceDataModule
from forbes.data.datamodule import require_divisible
from forbes.errors import ForbesError
from forbes.runs.launched import launched_devices
from forbes.training.world_model import WorldModel

__all__ = ["require_processes", "require_usable"]


class _Rule(NamedTuple):
    """Accepted values of an argument, as a function and in words."""

    argument: str
    accepts: Callable[[Any], bool]
    expected: str


def _is_definite(devices: Any) -> bool:
    """Return whether this is a number of devices, or a list of indices such as `3,` or `[0, 1]`."""
    return re.fullmatch(r"[1-9]\d*|\d+,(\d+)?|\[\d+(, ?\d+)*\]", str(devices)) is not None


def _num_processes(trainer: Namespace) -> int:
    """Return the number of processes of a training: one for each device of each machine."""
    devices = str(trainer["devices"])
    here = int(devices) if devices.isdecimal() else len(re.findall(r"\d+", devices))
    return here * int(trainer["num_nodes"])


def _no_precision(plugins: Any) -> bool:
    listed = plugins if isinstance(plugins, list) else [plugins]
    return not any(isinstance(plugin, Precision) for plugin in listed)


_STRATEGIES = ("auto", "ddp", "ddp_find_unused_parameters_true", "ddp_find_unused_parameters_false")
_WHOLE_EPOCHS = "An agent trains in whole epochs, each with an episode of its own. Set --trainer.max_epochs"
_ALWAYS = (
    _Rule("devices", _is_definite, "a number above 0, or indices as [0,1]. The noise depends on the number"),
    _Rule(
        "num_nodes",
        lambda nodes: nodes == 1 or launched_devices() is not None,
        "1. Start the processes on several machines with torchrun or SLURM",
    ),
    _Rule(
        "strategy",
        lambda strategy: strategy in _STRATEGIES,
        "auto or ddp. Each device has the whole model and its share of every batch",
    ),
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
    _Rule(
        "val_check_interval",
        lambda interval: interval is None or isinstance(interval, int | float),
        "a number of updates, or a fraction of an epoch. After a time, a resumed run would validate elsewhere",
    ),
    _Rule("model_registry", lambda name: name is None, "null. It is for the checkpoints of Lightning's own callback"),
)
_OF_SEVERAL_PROCESSES = tuple(
    _Rule(
        f"limit_{split}_batches",
        lambda limit: limit is None or limit == 0 or (limit == 1 and isinstance(limit, float)),
        "null or 0. Each process would take as many. Set --data.validation_sequences",
    )
    for split in ("val", "test")
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
    _Rule("accumulate_grad_batches", lambda batches: batches == 1, "1. Averages over updates move with every batch"),
)


def require_usable(trainer: Namespace, command: str, model: LightningModule, data: SequenceDataModule) -> None:
    """Refuse arguments of the Trainer that would not have their documented effect, and loops that an agent has not.

    Args:
        trainer: section `trainer` of the configuration, with its classes instantiated.
        command: fit, validate, test or predict.
        model: module to train.
        data: data module.

    Raises:
        ForbesError: for the first refused argument, or the loop.
    """
    if command != "fit" and isinstance(data.source, Experience):
        raise ForbesError(f"forbes {command}: an agent is measured by its returns. Use: forbes evaluate RUN")
    rules = list(_ALWAYS)
    rules += _OF_SEVERAL_PROCESSES if _num_processes(trainer) > 1 else ()
    rules += _OF_A_WORLD_MODEL if isinstance(model, WorldModel) else ()
    rules += _OF_AN_AGENT if isinstance(data.source, Experience) else ()
    for rule in rules:
        if not rule.accepts(value := trainer[rule.argument]):
            found = type(value).__name__ if rule.argument == "plugins" else value
            raise ForbesError(f"trainer.{rule.argument}: is {found}, expected {rule.expected}")
    require_divisible(data.batch_size, _num_processes(trainer))


def require_processes(trainer: Namespace, command: str, on_divergence: str) -> None:
    """Refuse what several processes cannot do.

    Args:
        trainer: section `trainer` of the configuration.
        command: fit, validate, test or predict.
        on_divergence: what `fit` does after a divergence.

    Raises:
        ForbesError: if it is for one process, and there are several.
    """
    if _num_processes(trainer) > 1 and command == "predict":
        raise ForbesError("forbes predict: prints in order, expected one process. Set --trainer.devices 1")
    if _num_processes(trainer) > 1 and on_divergence != "stop":
        raise ForbesError(f"--on-divergence {on_divergence}: expected one process. Set --trainer.devices 1")
