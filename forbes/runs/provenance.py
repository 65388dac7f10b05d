"""Provenance of a run: command, time, machine, versions and data."""

import json
import os
import platform
import shlex
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
import yaml
from jsonargparse import Namespace
from lightning import LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, SaveConfigCallback
from lightning.pytorch.utilities.exceptions import SIGTERMException

import forbes
from forbes.data.datamodule import datamodule_of
from forbes.errors import ForbesError
from forbes.files import replace_file
from forbes.reading import read_json
from forbes.runs.configuration import allowed_modules
from forbes.runs.folder import RunFolder
from forbes.runs.stop import StopOnSignal

__all__ = ["RecordRun", "command_line", "commit", "origin", "read_provenance"]

PACKAGES = ("torch", "lightning", "jsonargparse", "numpy", "dm-control", "mujoco", "gymnasium")
"""Packages that may change the results of a run; gymnasium is optional."""


class RecordRun(SaveConfigCallback):
    """Writes `config.yaml` and `provenance.json` with one entry per start, which is completed at the end.

    An entry without `exit_status` belongs to a process that was killed or is still running.

    Args:
        parser: parser of the command line.
        config: complete configuration.
        run: run folder to write to.
        stop: callback that knows which signal ended the training.
        arguments: arguments of the command line.
    """

    def __init__(
        self,
        parser: LightningArgumentParser,
        config: Namespace,
        run: RunFolder,
        stop: StopOnSignal,
        arguments: Sequence[str],
    ) -> None:
        super().__init__(parser, config, save_to_log_dir=False)
        self.run, self.stop, self.arguments = run, stop, arguments
        self._began = time.monotonic()
        self._entries: list[dict[str, Any]] = []  # stays empty in all processes of a training but the first

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write both files before the training starts, and log the configuration as hyperparameters."""
        content = self.parser.dump(self.config, skip_unset=False)
        replace_file(self.run.config, content.encode())
        for logger in trainer.loggers:
            logger.log_hyperparams(yaml.safe_load(content))
        path = self.run.provenance
        self._entries = read_provenance(path) if path.is_file() else []
        seed = {"seed": self.config["seed_everything"]}
        self._entries.append(_describe(self.arguments) | seed | _describe_data(trainer))
        self._write()

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Record success."""
        self._end(0)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Record the failure, or the signal that ended the training."""
        failed = exception.exit_status if isinstance(exception, ForbesError) else 1
        with suppress(ForbesError):  # on a full disk the original error is more important than its record
            stopped = isinstance(exception, SIGTERMException) or self.stop.received is not None
            self._end(self.stop.exit_status if stopped else failed)

    def _end(self, exit_status: int) -> None:
        if self._entries:
            hours = round((time.monotonic() - self._began) / 3600, 4)
            self._entries[-1] |= {"hours": hours, "exit_status": exit_status}
            self._write()

    def _write(self) -> None:
        replace_file(self.run.provenance, json.dumps(self._entries, indent=2).encode() + b"\n")


def read_provenance(path: Path) -> list[dict[str, Any]]:
    """Read provenance.json.

    Raises:
        ForbesError: if it is not a list of entries.
    """
    remedy = "Move it out of the run folder, and repeat the command"
    entries = read_json(path, remedy)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ForbesError(f"{path}: expected a list with one entry per start. {remedy}")
    return entries


def _describe(arguments: Sequence[str]) -> dict[str, Any]:
    """Return command, time, commit, versions and machine."""
    return {
        "command": command_line(*arguments),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "versions": _versions(),
        "machine": {
            "name": platform.node(),
            "system": platform.platform(),
            "cpus": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        },
    }


def _versions() -> dict[str, str]:
    versions = {"forbes": forbes.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def _describe_data(trainer: Trainer) -> dict[str, Any]:
    """Return the hash of the data."""
    return {"data_sha256": datamodule_of(trainer).source.sha256()}


def command_line(*arguments: str) -> str:
    """Return the command line to repeat a command, with the `--allow-module` flags of this process."""
    return shlex.join(["forbes", *allowed_modules(), *arguments])


def origin(command: str, seed: int) -> dict[str, Any]:
    """Return command, commit, random seed and date, for the record of a result."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"command": command, "commit": commit(), "seed": seed, "date": date}


def commit() -> str | None:
    """Return the commit of this checkout, with +dirty if files are changed; None outside a git checkout."""
    root = Path(forbes.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    git = ["git", "-C", str(root)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+dirty" if changes.stdout.strip() else "")
