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
from forbes.errors import ForbesError
from forbes.figures.style import save_figure
from forbes.seeding import derive_seed
from forbes.training.world_model import WorldModel

__all__ = ["PictureCallback", "to_device"]


class PictureCallback(Callback, ABC):
    """Draws a picture into the run's `figures/`, anew after every k-th validation and at the end of the fit.

    A training with it is bitwise the same as one without: it draws with random numbers of its own.

    Args:
        every: k.
    """

    filename: str
    """Of the picture."""

    def __init__(self, every: int = 5) -> None:
        if every < 1:
            raise ForbesError(f"{type(self).__name__}: every is {every}, expected at least 1.")
        self.every = every
        self._drawn_at = -1

    @abstractmethod
    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw, without gradients, on the module's device."""

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw after every k-th validation of a fit."""
        fitting = trainer.state.fn == "fit" and not trainer.sanity_checking
        if fitting and (trainer.current_epoch + 1) % self.every == 0:
            self._save(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the finished model."""
        self._save(trainer, pl_module)

    def _save(self, trainer: Trainer, module: LightningModule) -> None:
        folder = trainer.log_dir  # asks every process, so every process must ask
        if folder is None or not trainer.is_global_zero or self._drawn_at == trainer.global_step:
            return
        with _own_randomness(module, self.filename):
            # Lightning gives `trainer.datamodule` no type, and every hook a LightningModule.
            figure = self.draw(trainer, cast(WorldModel, module), trainer.datamodule)  # type: ignore[attr-defined]
        save_figure(figure, Path(folder) / "figures" / self.filename)
        self._drawn_at = trainer.global_step


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
