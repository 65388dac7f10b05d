"""Stop a training before the first update that is not finite."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from forbes.data.datamodule import datamodule_of
from forbes.rounding import ceil_div
from forbes.runs.folder import RunFolder
from forbes.runs.saving import AtomicCheckpointIO
from forbes.training.divergence import DivergedError, hold_unless_finite

__all__ = ["StopAtDivergence"]


class StopAtDivergence(Callback):
    """Stops a training whose optimiser is held, and refuses checkpoints with parameters that are not finite.

    On a CPU it checks after every update. On a GPU it checks once per logging interval, when Lightning synchronises
    anyway, and before each checkpoint. `failure.pt` in the run folder then has everything to repeat the update: the
    weights and the optimiser state before it, its batches, and the seed of its noise (`forbes replay`).

    Args:
        run: run folder to write `failure.pt` to.

    Raises:
        DivergedError: with the number of the update.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Copy what is not optimised, e.g. running averages: a held optimiser does not keep it from changing."""
        optimised = {name for name, parameter in pl_module.named_parameters() if parameter.requires_grad}
        state = {name: values for name, values in pl_module.state_dict().items() if name not in optimised}
        self._moving = {name: (values, values.clone()) for name, values in state.items()}

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        """Copy it again before each update, up to that of the divergence."""
        if not self._moving or batch_idx % trainer.accumulate_grad_batches:
            return
        never = torch.full((), math.inf, device=pl_module.device)
        held_from = torch.stack([vars(optimizer).get("held_from", never) for optimizer in trainer.optimizers])
        for values, copy in self._moving.values():
            copy.copy_(torch.where(held_from.isfinite().any(), copy, values))

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        """Hold the optimiser if the loss is not finite. The module does this for the gradient."""
        for optimizer in trainer.optimizers:
            hold_unless_finite(optimizer, loss, trainer.global_step)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: object, batch_idx: int
    ) -> None:
        """Stop after a divergence, if the check does not cost an extra synchronisation."""
        interval = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if pl_module.device.type == "cpu" or (interval and trainer.global_step % interval == 0):
            self._stop_if_held(trainer, pl_module)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop after a divergence, before the checkpoint."""
        self._stop_if_held(trainer, pl_module)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint from which a training could not continue."""
        self._stop_if_held(trainer, pl_module)
        for name, parameter in pl_module.named_parameters():
            if not parameter.isfinite().all():
                raise DivergedError(
                    f"{self.run}: {name} is not finite after update {trainer.global_step}, so no checkpoint is "
                    "written; the previous one is unchanged. Resume from it with a lower learning rate",
                    trainer.global_step,
                )

    def _stop_if_held(self, trainer: Trainer, module: LightningModule) -> None:
        held_from = (float(vars(optimizer).get("held_from", math.inf)) for optimizer in trainer.optimizers)
        held = min(held_from, default=math.inf)
        if math.isinf(held):
            return
        update = int(held)
        if trainer.is_global_zero:
            before = {name: copy for name, (_, copy) in self._moving.items()}
            AtomicCheckpointIO().save_checkpoint(_failure_record(trainer, module, update, before), self.run.failure)
        command = f"forbes fit --resume {self.run}" if self.run.checkpoint.exists() else "the same command"
        raise DivergedError(
            f"{self.run}: diverged, the loss or gradient of update {update + 1} is not finite. See where: "
            f"forbes replay {self.run.failure}. Give a lower --model.learning_rate to {command}",
            update + 1,
        )


def _failure_record(
    trainer: Trainer, module: LightningModule, update: int, before: dict[str, Tensor]
) -> dict[str, Any]:
    """Return plain values and tensors from which the update can be recomputed, with the state before it.

    Args:
        trainer: its optimiser has changed nothing since.
        module: module whose weights are those before the update.
        update: number of the update.
        before: what is not optimised, as it was before the update.
    """
    data = datamodule_of(trainer)
    numbers = _batches_of(update, int(trainer.num_training_batches), trainer.accumulate_grad_batches)
    drawn: Sequence[int] = numbers
    if trainer.overfit_batches:  # type: ignore[attr-defined]  # all epochs have the same batches
        drawn = [number % int(trainer.num_training_batches) for number in numbers]
    return {
        "update": update,
        "seed": getattr(module, "seed", None),
        "processes": trainer.world_size,
        "device": module.device.type,
        "precision": trainer.precision,
        "state_dict": module.state_dict() | before,
        "optimizer_states": [optimizer.state_dict() for optimizer in trainer.optimizers],
        "batch_numbers": [*numbers],
        "batches": [data.sequences("train", data.train_index(number))._asdict() for number in drawn],
    }


def _batches_of(update: int, per_epoch: int, per_update: int) -> range:
    """Return the numbers of the batches of an update. The last update of an epoch may have fewer batches."""
    epoch, in_epoch = divmod(update, ceil_div(per_epoch, per_update))
    first = in_epoch * per_update
    return range(epoch * per_epoch + first, epoch * per_epoch + min(first + per_update, per_epoch))
