"""A clean stop: Ctrl-C and SIGTERM end a training where it can go on, with a checkpoint to go on from."""

import os
import signal
from types import FrameType
from typing import Any, cast

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from forbes.data import Experience
from forbes.runs.folder import RunFolder

__all__ = ["StopOnSignal"]


class StopOnSignal(Callback):
    """Stops a training at the first SIGINT or SIGTERM as soon as its state is whole; at the second at once.

    That is after the update at hand; for an agent, whose epoch begins with an episode that a resumed one would lack,
    after the epoch.

    Left alone, Lightning breaks off in the middle of an update at Ctrl-C, and saves nothing at either signal.

    Args:
        run: where the state is saved.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run
        self.received: int | None = None

    @property
    def exit_status(self) -> int:
        """What a shell expects of a process that a signal has ended: 130 for Ctrl-C, 143 for SIGTERM.

        One that came before the training began was received by Lightning, which knows SIGTERM only.
        """
        return 128 + (self.received or signal.SIGTERM)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the place of Lightning's handler, which it puts back itself after the training."""
        self._end_loop = signal.getsignal(signal.SIGTERM)
        self._whole_epochs = isinstance(trainer.datamodule.source, Experience)  # type: ignore[attr-defined]
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._receive)
        if trainer.received_sigterm:  # since the start; Lightning would end the loop within an agent's epoch
            cast(Any, trainer)._signal_connector.received_sigterm = False
            self._receive(signal.SIGTERM, None)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        """End the loop after this update, unless a validation follows, which must not be left half done."""
        updates = (batch_idx + 1) % trainer.accumulate_grad_batches == 0  # a checkpoint has no half-summed gradients
        if updates and not trainer.is_last_batch and not self._whole_epochs:
            self._end()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """End the loop after this epoch."""
        self._end()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save, when the loop has ended because of a signal."""
        if isinstance(exception, SIGTERMException):
            trainer.save_checkpoint(self.run.checkpoint)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise SystemExit(128 + number)
        self.received = number
        if self._whole_epochs:  # which may take minutes; print could be what was interrupted
            os.write(2, b"\nstopping after this epoch; once more to stop at once, and lose it\n")

    def _end(self) -> None:
        if self.received is not None and callable(self._end_loop):
            self._end_loop(signal.SIGTERM, None)
