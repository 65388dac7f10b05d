"""What the drawing callbacks share: when they draw, where to, and that a training never notices."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from lightning import Callback, LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.data import SequenceBatch, SequenceDataModule
from forbes.errors import ForbesError, require_at_least
from forbes.evaluation.predictions import first_of_each_class
from forbes.figures.grids import require_images
from forbes.figures.style import save_figure
from forbes.models import StateSpaceModel
from forbes.seeding import derive_seed
from forbes.training.world_model import WorldModel

__all__ = [
    "FileCallback",
    "PictureCallback",
    "require_context",
    "require_frames",
    "require_state",
    "shown_sequences",
    "to_device",
]


class FileCallback(Callback, ABC):
    """Leaves a file in the run's `figures/`, anew after every k-th epoch and at the end of the fit.

    A training with it is bitwise the same as one without: it has random numbers of its own. An epoch's file is made
    when the next one begins, so that all the epoch's metrics are there.

    Args:
        every: k.
    """

    filename: str
    """Of the file."""

    def __init__(self, every: int = 5) -> None:
        require_at_least(1, type(self).__name__, every=every)
        self.every = every

    @abstractmethod
    def write(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule, path: Path) -> None:
        """Write the file, without gradients, in eval mode, on the module's device."""

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show the model after every k-th epoch."""
        if trainer.current_epoch > 0 and trainer.current_epoch % self.every == 0:
            self._write(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show the finished model."""
        self._write(trainer, pl_module)

    def _write(self, trainer: Trainer, module: LightningModule) -> None:
        folder = trainer.log_dir  # asks every process, so every process must ask
        if folder is None or not trainer.is_global_zero:
            return
        with _own_randomness(module, self.filename):
            # Lightning gives `trainer.datamodule` no type, and every hook a LightningModule.
            data = trainer.datamodule  # type: ignore[attr-defined]
            self.write(trainer, cast(WorldModel, module), data, Path(folder) / "figures" / self.filename)


class PictureCallback(FileCallback):
    """A `FileCallback` whose file is a picture."""

    @abstractmethod
    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw, without gradients, in eval mode, on the module's device."""

    def write(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule, path: Path) -> None:
        """See `FileCallback`."""
        save_figure(self.draw(trainer, module, data), path)


@contextmanager
def _own_randomness(module: LightningModule, purpose: str) -> Iterator[None]:
    """Compute in eval mode, without gradients and with a seed of one's own; restore all three."""
    training = module.training
    cuda = [module.device] if module.device.type == "cuda" else []
    with torch.no_grad(), torch.random.fork_rng(cuda):
        torch.manual_seed(derive_seed(0, purpose, 0))
        module.eval()
        yield
        module.train(training)


def to_device(batch: SequenceBatch, module: LightningModule) -> SequenceBatch:
    """Move a batch to where the module is."""
    return SequenceBatch(*(values.to(module.device) for values in batch))


def shown_sequences(data: SequenceDataModule, count: int, module: LightningModule) -> SequenceBatch:
    """Return sequences that no model has a say in, where the module is.

    They are the first of each class of the validation split. An agent's experience has no such split: then they are the
    beginnings of the newest episodes, which it has learned from least, or not yet where `Collect` comes before.
    """
    if data.source.size("validation"):
        batch = data.sequences("validation", first_of_each_class(data, "validation", count))
    else:
        batch = data.sequences("train", data.source.latest(count))
    return to_device(batch, module)


def require_context(callback: Callback, trainer: Trainer, context: int) -> None:
    """Raise a ForbesError unless a context leaves something to predict, before hours are spent."""
    length = trainer.datamodule.length  # type: ignore[attr-defined]  # Lightning gives it no type
    if context >= length:
        name = type(callback).__name__
        raise ForbesError(f"{name}: context is {context}, expected less than the length {length}. Choose a smaller one")


def require_state(callback: Callback, module: LightningModule) -> None:
    """Raise a ForbesError for a model without a state."""
    if not isinstance(model := module.model, StateSpaceModel):
        raise ForbesError(
            f"{type(callback).__name__}: {type(model).__name__} has no state to plot. Leave this callback out"
        )


def require_frames(callback: Callback, trainer: Trainer) -> None:
    """Raise a ForbesError unless the observations are images."""
    shape = trainer.datamodule.observation_shape  # type: ignore[attr-defined]
    require_images(type(callback).__name__, shape, "Leave this callback out, or observe pixels")
