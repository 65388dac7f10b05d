"""Loggers of a configuration: they write into the run folder, unless the configuration names another folder."""

import inspect
from functools import partial
from pathlib import Path
from typing import Any

from jsonargparse import Namespace
from lightning.pytorch.cli import LightningArgumentParser
from lightning.pytorch.loggers import Logger

__all__ = ["ParserOfRuns", "open_logger"]

_FOLDERS = ("save_dir", "root_dir")
"""What loggers call the argument that names their folder."""


class ParserOfRuns(LightningArgumentParser):
    """A parser for runs whose folder is made after their configuration is known.

    A logger may be given without a folder, even where its class requires one. Instantiated it is a partial, for
    `open_logger`.
    """

    def validate(self, namespace: Namespace, *args: Any, **kwargs: Any) -> None:
        """Accept loggers without a folder."""
        completed = namespace.clone()
        loggers = completed.get("trainer.logger")
        for logger in loggers if isinstance(loggers, list) else [loggers]:
            arguments = logger.get("init_args") if isinstance(logger, Namespace) else {}
            for name in _FOLDERS:
                if name in arguments and arguments[name] is None:
                    arguments[name] = "the run folder"
        super().validate(completed, *args, **kwargs)

    def instantiate(self, namespace: Namespace, *args: Any, **kwargs: Any) -> Namespace:
        """Instantiate everything but the loggers."""
        built: Namespace = super().instantiate(namespace, *args, **kwargs, instantiators=[(_later, Logger, True)])
        return built


def _later(kind: type[Logger], **arguments: Any) -> "partial[Logger]":
    return partial(kind, **arguments)


def open_logger(logger: "partial[Logger]", run: Path) -> Logger:
    """Build a logger.

    Args:
        logger: its class with the arguments of the configuration.
        run: the run folder. It replaces a folder that is not given. A default is relative to it, as `./mlruns` is.
    """
    parameters = inspect.signature(logger.func).parameters
    for name in _FOLDERS:
        given = logger.keywords.get(name)
        if name in parameters and given in (None, parameters[name].default):
            return logger(**{name: str(run / (given or ""))})
    return logger()
