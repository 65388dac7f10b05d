"""The logger of every run: an append-only file of JSON lines, robust to kills and resumes."""

import json
from argparse import Namespace
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from forbes.files import append_whole, drop_half_line

__all__ = ["JsonLinesLogger", "MarkStart"]


class JsonLinesLogger(Logger):
    """Appends {"update": n, "epoch": e, name: value, ...} for each set of metrics; `read_metrics` reads them.

    `update` is the number of optimiser updates before the values were measured. A line has been handed to the system
    when `log_metrics` returns, so a killed process loses no line before its checkpoint.

    Args:
        path: file to append to, `metrics.jsonl` in a run folder.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._whole = False

    @property
    def name(self) -> str:
        """Empty, since Lightning's folder is `save_dir / name / version`."""
        return ""

    @property
    def version(self) -> str:
        """Empty, since Lightning's folder is `save_dir / name / version`."""
        return ""

    @property
    def save_dir(self) -> str:
        """The run folder, available to callbacks as `trainer.log_dir`."""
        return str(self.path.parent)

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Append one line. Lightning's `step` is the index of the last update."""
        self._append({"update": (-1 if step is None else step) + 1, **metrics})

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Do nothing, since the hyperparameters are in config.yaml."""

    @rank_zero_only
    def mark_start(self, update: int) -> None:
        """Append a mark that a process starts at this update: earlier lines of later updates are obsolete."""
        self._append({"update": update, "start": True})

    def _append(self, record: dict[str, Any]) -> None:
        if not self._whole:
            drop_half_line(self.path)
            self._whole = True
        append_whole(self.path, json.dumps(record).encode() + b"\n")


class MarkStart(Callback):
    """Marks in every `JsonLinesLogger` the update at which a training starts or resumes."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the mark before the first update."""
        for logger in trainer.loggers:
            if isinstance(logger, JsonLinesLogger):
                logger.mark_start(trainer.global_step)
