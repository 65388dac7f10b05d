"""The record of a run: its configuration, and an entry of its provenance for every start."""

import json
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import yaml
from jsonargparse import Namespace
from lightning import LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, SaveConfigCallback
from lightning.pytorch.utilities.exceptions import SIGTERMException

from forbes.data.datamodule import datamodule_of
from forbes.errors import ForbesError
from forbes.files import replace_file
from forbes.runs.folder import RunFolder
from forbes.runs.provenance import describe_start, read_provenance
from forbes.runs.stop import StopOnSignal

__all__ = ["RecordRun"]


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
        seed, data = self.config["seed_everything"], datamodule_of(trainer).source.sha256()
        self._entries.append(describe_start(self.arguments) | {"seed": seed, "data_sha256": data})
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
