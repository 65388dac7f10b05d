"""Loggers of a configuration, which write to the run folder unless the configuration names another folder."""

import inspect
from functools import partial
from pathlib import Path
from typing import Any

from jsonargparse import Namespace
from lightning.pytorch.cli import LightningArgumentParser
from lightning.pytorch.loggers import Logger

__all__ = ["ParserOfRuns", "open_logger"]

_FOLDERS = ("save_dir", "root_dir")
"""Names of the argument for a logger's folder."""


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
            arguments = logger.get("init_args") if isinstance(logger, Namespace) else {}
            for name in _FOLDERS:
                if name in arguments and arguments[name] is None:
                    arguments[name] = "the run folder"
        super().validate(completed, *args, **kwargs)

    def instantiate(self, namespace: Namespace, *args: Any, **kwargs: Any) -> Namespace:
        """Instantiate everything except the loggers."""
        built: Namespace = super().instantiate(namespace, *args, **kwargs, instantiators=[(_later, Logger, True)])
        return built


def _later(kind: type[Logger], **arguments: Any) -> "partial[Logger]":
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
