"""Base classes of the drawing callbacks, which do not affect the training."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import torch
from lightning import Callback, LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.data import Experience, SequenceBatch, SequenceDataModule
from forbes.data.datamodule import datamodule_of
from forbes.errors import ForbesError, require_at_least
from forbes.evaluation.predictions import first_of_each_class
from forbes.figures.grids import require_images
from forbes.figures.style import save_figure
from forbes.models import StateSpaceModel
from forbes.runs.loggers import show_picture, shows
from forbes.runs.metrics_log import JsonLinesLogger
from forbes.seeding import derive_seed, forked
from forbes.training.world_model import WorldModel

__all__ = [
    "FileCallback",
    "PictureCallback",
    "require_context",
    "require_frames",
    "require_metrics",
    "require_one_array",
    "require_state",
    "require_validation",
    "shown_sequences",
]


class FileCallback(Callback, ABC):
    """Writes a file in the run's `figures/` after every k-th epoch and at the end of the fit; none in a dry run.

    It uses its own random numbers, so a training with it is bitwise the same as one without. The file of an epoch is
    written at the start of the next one, when all metrics of the epoch are logged. Loggers of TensorBoard and W&B show
    it too, as `figures/NAME`.

    Args:
        every: number of epochs between files, k.
    """

    filename: str
    """Name of the file in `figures/`."""
    folder: Path
    """The run folder, while the file is written. `trainer.log_dir` is collective, and only one process writes."""

    def __init__(self, every: int = 5) -> None:
        require_at_least(1, type(self).__name__, every=every)
        self.every = every

    @abstractmethod
    def write(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule, path: Path) -> None:
        """Write the file. Called without gradients, in eval mode, on the module's device."""

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the file after every k-th epoch."""
        if trainer.current_epoch > 0 and trainer.current_epoch % self.every == 0:
            self._write(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the file for the finished model."""
        self._write(trainer, pl_module)

    def _write(self, trainer: Trainer, module: LightningModule) -> None:
        if _is_dry(trainer):  # it has neither a run folder nor metrics
            return
        folder = trainer.log_dir  # a collective operation, so every process must call it
        if folder is None or not trainer.is_global_zero:
            return
        self.folder = Path(folder)
        with _own_randomness(module, self.filename):
            path = self.folder / "figures" / self.filename
            self.write(trainer, cast(WorldModel, module), datamodule_of(trainer), path)
        for logger in trainer.loggers:
            if shows(logger, self.filename):
                show_picture(logger, path, trainer.global_step)


class PictureCallback(FileCallback):
    """A `FileCallback` whose file is a figure."""

    @abstractmethod
    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Return the figure. Called without gradients, in eval mode, on the module's device."""

    def write(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule, path: Path) -> None:
        """Draw the figure and save it."""
        save_figure(self.draw(trainer, module, data), path)


def _is_dry(trainer: Trainer) -> bool:
    """Return whether this is a run of a few updates that leaves nothing, `--trainer.fast_dev_run`."""
    return bool(cast(Any, trainer).fast_dev_run)


@contextmanager
def _own_randomness(module: LightningModule, purpose: str) -> Iterator[None]:
    """Compute in eval mode, without gradients and with a separate random seed; restore all three afterwards."""
    training = module.training
    with torch.no_grad(), forked(module.device, derive_seed(0, purpose, 0)):
        module.eval()
        yield
        module.train(training)


def shown_sequences(data: SequenceDataModule, count: int, module: LightningModule) -> SequenceBatch:
    """Return sequences to show, on the module's device; their choice does not depend on the model.

    They are the first of each class of the validation split. The experience of an agent has no validation split: then
    they are the beginnings of the newest episodes, which the agent has used least.
    """
    if data.source.size("validation"):
        batch = data.sequences("validation", first_of_each_class(data, "validation", count))
    else:
        batch = data.sequences("train", data.source.latest(count))
    return batch.to(module.device)


def require_validation(callback: Callback, trainer: Trainer) -> None:
    """Raise a ForbesError if the data have no validation split: those of an agent, or too few episodes."""
    source = datamodule_of(trainer).source
    if isinstance(source, Experience) or not source.size("validation"):
        raise ForbesError(
            f"{type(callback).__name__}: the data have no validation split, from which it draws. Remove this callback"
        )


def require_context(callback: Callback, trainer: Trainer, context: int) -> None:
    """Raise a ForbesError unless the context is shorter than the sequences."""
    length = datamodule_of(trainer).length
    if context >= length:
        name = type(callback).__name__
        raise ForbesError(f"{name}: context is {context}, expected less than the length {length}. Choose a smaller one")


def require_metrics(callback: Callback, trainer: Trainer) -> None:
    """Raise a ForbesError if the training does not write the `metrics.jsonl` that the callback draws."""
    if not _is_dry(trainer) and not any(isinstance(logger, JsonLinesLogger) for logger in trainer.loggers):
        raise ForbesError(
            f"{type(callback).__name__}: draws metrics.jsonl, which this training does not write. Remove this "
            "callback, or keep the logger of `forbes fit`"
        )


def require_state(callback: Callback, module: LightningModule) -> None:
    """Raise a ForbesError for a model without a state."""
    if not isinstance(model := module.model, StateSpaceModel):
        raise ForbesError(
            f"{type(callback).__name__}: {type(model).__name__} has no state to plot. Remove this callback"
        )


def require_one_array(callback: Callback, trainer: Trainer) -> None:
    """Raise a ForbesError if observations have several parts."""
    if isinstance(shape := datamodule_of(trainer).observation_shape, dict):
        raise ForbesError(
            f"{type(callback).__name__}: the observations have the parts {', '.join(shape)}, expected one array. "
            "Remove this callback"
        )


def require_frames(callback: Callback, trainer: Trainer) -> None:
    """Raise a ForbesError unless the observations are images, or have some among their parts."""
    shape = datamodule_of(trainer).observation_shape
    require_images(type(callback).__name__, shape, "Remove this callback, or observe pixels")
