"""Progress of a training: a bar on a terminal, one plain line per epoch elsewhere."""

import math
import sys
import time
from datetime import timedelta
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar, RichProgressBar

__all__ = ["PlainProgress", "TerminalProgress", "progress"]

_STEPS = ("env_steps", "agent_steps")


def progress() -> ProgressBar:
    """Return the progress bar for the current output."""
    return TerminalProgress() if sys.stdout.isatty() else PlainProgress()


class TerminalProgress(RichProgressBar):
    """Lightning's progress bar with the objectives."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """Return the metrics on the right of the bar."""
        return dict(_objectives(trainer, pl_module))


class PlainProgress(ProgressBar):
    """Prints one line per epoch: updates, time, speed, objectives and the remaining time.

    Example::

        epoch 2/20  update 1000/10000  0:01:40  10.0 updates/s  train/elbo[bernoulli,S=1] -240.1  left 0:15:00
    """

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True

    def disable(self) -> None:
        """Stop printing. Lightning calls this on every process except the first."""
        self._enabled = False

    def enable(self) -> None:
        """Resume printing."""
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._start, self._first = time.monotonic(), trainer.global_step

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the line, after the validation of the epoch."""
        if not self._enabled:
            return
        elapsed = time.monotonic() - self._start
        rate = (trainer.global_step - self._first) / elapsed
        total = trainer.estimated_stepping_batches  # infinite for max_epochs: -1
        ends = math.isfinite(total)
        objectives = _objectives(trainer, pl_module)
        fields = [
            f"epoch {trainer.current_epoch + 1}" + f"/{trainer.max_epochs}" * ends,
            f"update {trainer.global_step}" + f"/{total}" * ends,
            str(timedelta(seconds=round(elapsed))),
            f"{rate:.1f} updates/s",
            *(f"{name} {value}" for name, value in objectives.items()),
        ]
        if ends:
            fields.append(f"left {timedelta(seconds=round((total - trainer.global_step) / rate))}")
        print("  ".join(fields), flush=True)


def _objectives(trainer: Trainer, module: LightningModule) -> dict[str, str]:
    """Return the latest objective of each split, and an agent's steps, returns and reward predictions, as text."""
    objective = getattr(module, "objective_name", "loss")  # third-party modules may have none
    return {
        name: _shown(name, float(value))
        for name, value in trainer.callback_metrics.items()
        if name.endswith(f"/{objective}") or name in _STEPS or name.startswith(("return/", "reward_explained/"))
    }


def _shown(name: str, value: float) -> str:
    if name in _STEPS:
        return f"{value:,.0f}"
    return f"{value:.{1 if abs(value) >= 100 else 3}f}"
