"""Loggers of a configuration: they write to the run folder unless it names another, and show pictures if they can."""

import inspect
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jsonargparse import Namespace
from lightning.pytorch.cli import LightningArgumentParser
from lightning.pytorch.loggers import CometLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from PIL import Image

from forbes.errors import ForbesError

__all__ = ["ParserOfRuns", "open_logger", "show_picture", "shows"]

_FOLDERS = ("save_dir", "root_dir")
"""Names of the argument for a logger's folder."""
_PACKAGES: tuple[tuple[type[Logger], tuple[str, ...], str], ...] = (
    (TensorBoardLogger, ("tensorboard", "tensorboardX"), "'forbes[tracking]'"),
    (WandbLogger, ("wandb",), "wandb"),
    (MLFlowLogger, ("mlflow",), "mlflow"),
    (CometLogger, ("comet_ml",), "comet-ml"),
)
"""Loggers, the modules of which they need one, and what to install."""


class ParserOfRuns(LightningArgumentParser):
    """A parser for runs whose folder is created after parsing.

    A logger may be given without a folder, even if its class requires one. It is instantiated as a partial, for
    `open_logger`.
    """

    def validate(self, namespace: Namespace, *args: Any, **kwargs: Any) -> None:
        """Accept loggers without a folder."""
        completed = namespace.clone()
        loggers = completed.get("trainer.logger")
        for logger in loggers if isinstance(loggers, list) else [loggers]:
            arguments = logger.get("init_args") if isinstance(logger, Namespace) else None
            for name in _FOLDERS:
                if arguments and name in arguments and arguments[name] is None:
                    arguments[name] = "the run folder"
        super().validate(completed, *args, **kwargs)

    def instantiate(self, namespace: Namespace, *args: Any, **kwargs: Any) -> Namespace:
        """Instantiate everything except the loggers."""
        built: Namespace = super().instantiate(namespace, *args, **kwargs, instantiators=[(_later, Logger, True)])
        return built


def _later(kind: type[Logger], **arguments: Any) -> "partial[Logger]":
    """Return a logger to be instantiated once there is a run folder. Its package is required before there is one."""
    for base, modules, install in _PACKAGES:
        if issubclass(kind, base) and not any(map(find_spec, modules)):
            raise ForbesError(
                f"trainer.logger: {kind.__name__} needs {modules[0]}, which is not installed. Install it: "
                f"pip install {install}"
            )
    return partial(kind, **arguments)


def open_logger(logger: "partial[Logger]", run: Path) -> Logger:
    """Instantiate a logger.

    Args:
        logger: class of the logger with the arguments of the configuration.
        run: run folder, used if the logger has no folder. A default such as `./mlruns` is relative to it.
    """
    parameters = inspect.signature(logger.func).parameters
    for name in _FOLDERS:
        given = logger.keywords.get(name)
        if name in parameters and given in (None, parameters[name].default):
            return logger(**{name: str(run / (given or ""))})
    return logger()


def shows(logger: Logger, filename: str) -> bool:
    """Return whether a logger shows files of this name: W&B pictures and videos (.gif), TensorBoard pictures."""
    if filename.endswith(".gif"):
        return hasattr(logger, "log_video")
    return isinstance(logger, TensorBoardLogger) or hasattr(logger, "log_image")


def show_picture(logger: Logger, path: Path, step: int) -> None:
    """Send a file to a logger that `shows` it, as `figures/NAME`.

    Args:
        logger: logger of TensorBoard, or with the methods `log_image` and `log_video` of Lightning's `WandbLogger`.
        path: picture, or a video as .gif.
        step: number of updates.
    """
    name = f"figures/{path.stem}"
    if isinstance(logger, TensorBoardLogger):
        picture = np.asarray(Image.open(path).convert("RGB"))  # (H, W, 3)
        logger.experiment.add_image(name, picture, step, dataformats="HWC")
    elif path.suffix == ".gif":
        logger.log_video(name, [str(path)], step=step)  # type: ignore[attr-defined]
    else:
        logger.log_image(name, [str(path)], step=step)  # type: ignore[attr-defined]
