"""A clean stop: on a signal a training ends with a checkpoint from which it can resume."""

import math
import os
import signal
from types import FrameType
from typing import Any, cast

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from forbes.data import Experience
from forbes.data.datamodule import datamodule_of
from forbes.distributed import greatest
from forbes.runs.folder import RunFolder
from forbes.runs.launched import is_first
from forbes.runs.signals import ANNOUNCED, OF_A_USER

__all__ = ["StopOnSignal"]


class StopOnSignal(Callback):
    """Stops a training at a signal as soon as its state is consistent, at the second SIGINT or SIGTERM immediately.

    SIGUSR1 and SIGUSR2 are sent by SLURM and others before the time is over or a job is preempted. They may come in
    any number, next to one SIGTERM, and never stop a training immediately.

    The state is consistent after the current update, unless a validation follows it. For an agent it is consistent
    after the epoch, since the episode at the start of the epoch would be missing otherwise.

    Without this callback, Lightning stops in the middle of an update on Ctrl-C, and saves nothing on either signal.

    Args:
        run: run folder to save to.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run
        self.received: int | None = None
        self._asked = False  # by SIGINT or SIGTERM

    @property
    def exit_status(self) -> int:
        """Exit status of a process ended by a signal: 130 for Ctrl-C, 143 for SIGTERM, 138 and 140 for SIGUSR1 and 2.

        A signal before the start of the training is received by Lightning, which handles SIGTERM only.
        """
        return 128 + (self.received or signal.SIGTERM)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Replace Lightning's signal handlers, which Lightning restores after the training."""
        self._whole_epochs = isinstance(datamodule_of(trainer).source, Experience)
        for number in (*OF_A_USER, *ANNOUNCED):
            signal.signal(number, self._receive)
        if trainer.received_sigterm:  # before this point; Lightning would end the loop within an agent's epoch
            cast(Any, trainer)._signal_connector.received_sigterm = False
            self._receive(signal.SIGTERM, None)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        """End the loop after this update, unless a validation follows, which must be completed."""
        updates = (batch_idx + 1) % trainer.accumulate_grad_batches == 0  # a checkpoint has no half-summed gradients
        if updates and not _validation_follows(trainer, batch_idx) and not self._whole_epochs:
            self._end(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """End the loop after this epoch."""
        self._end(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save a checkpoint if a signal ended the loop."""
        if isinstance(exception, SIGTERMException):
            trainer.save_checkpoint(self.run.checkpoint)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if number in OF_A_USER:
            if self._asked:
                raise SystemExit(128 + number)
            self._asked = True
        if self.received is not None:
            return
        self.received = number
        if self._whole_epochs and is_first():  # may take minutes
            # `os.write`, since the signal may have interrupted a print
            os.write(2, b"\nstopping after this epoch; once more to stop immediately, and lose it\n")

    def _end(self, trainer: Trainer) -> None:
        """End the loop if any process of the training has received a signal, in all of them."""
        if received := greatest(self.received or 0, trainer.strategy.root_device):
            self.received = received
            cast(Any, trainer)._signal_connector.received_sigterm = True


def _validation_follows(trainer: Trainer, batch_idx: int) -> bool:
    """Return whether Lightning may validate after this batch: at the end of an epoch, or every `val_check_interval`."""
    number = trainer.fit_loop.total_batch_idx if trainer.check_val_every_n_epoch is None else batch_idx
    return trainer.is_last_batch or (number + 1) % (trainer.val_check_batch or math.inf) == 0
