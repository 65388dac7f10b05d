"""Say that a training has got worse than it was at its first validation."""

import sys

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

__all__ = ["WarnOfCollapse"]


class WarnOfCollapse(Callback):
    """Warns once, on stderr, when the validation bound is below that of the first validation since the start or resume.

    A loss can stay finite and be useless: after a few huge gradients a model may be worse than when it began, and never
    recover. Such a training is not stopped. An agent's episodes change, so its bounds do not compare, and it is left
    alone.
    """

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None
        self._warned = False

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Compare the bound, after the validation of the epoch."""
        metrics = trainer.callback_metrics
        metric = f"val/{getattr(pl_module, 'objective_name', 'loss')}"
        if metric not in metrics or metric == "val/loss" or "env_steps" in metrics:
            return
        value = float(metrics[metric])
        if self._first is None:
            self._first = value, trainer.global_step
        first, update = self._first
        if value < first and not self._warned and trainer.is_global_zero:
            self._warned = True
            best = "; checkpoints/best.ckpt has its best" if trainer.checkpoint_callback else ""
            print(
                f"forbes: {metric} is {value:.1f}, below the {first:.1f} of update {update}: the training may have "
                f"collapsed. Lower --model.learning_rate or --model.clip_norm{best}",
                file=sys.stderr,
                flush=True,
            )
