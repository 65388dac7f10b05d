"""Checkpoints that survive a kill at any time: written to a temporary file, verified, then renamed."""

import io
import math
import os
import shutil
from pathlib import Path
from typing import Any, cast

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import CheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint

from forbes.files import replace_file, require_room
from forbes.runs.checkpoint import DamagedCheckpointError, read_checkpoint, sealed, verify
from forbes.runs.folder import RunFolder

__all__ = ["AtomicCheckpointIO", "ResumeWholeEpochs", "SaveLast"]


class AtomicCheckpointIO(CheckpointIO):
    """Writes checkpoints atomically, and loads only tensors and plain values.

    Lightning's own plugin writes to the system's temporary folder and copies the file over the old checkpoint, so a
    full disk leaves a truncated checkpoint.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write a temporary file in the same folder, verify it, and rename it to `path`."""
        path = Path(path)
        buffer = io.BytesIO()  # on a full disk, torch.save to a file fails without a reason
        torch.save(checkpoint, buffer)

        def keep_others(written: Path) -> None:
            verify(path, written.read_bytes())
            if path.name == RunFolder.LAST:
                if checkpoint.get("best", {}).get("update", -1) == checkpoint.get("global_step"):
                    _name_too(written, RunFolder.BEST)
                if path.exists() and _is_intact(path):  # a damaged one must not replace the previous one
                    _name_too(path, RunFolder.PREVIOUS)

        replace_file(path, sealed(buffer.getvalue()), keep_others)

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU. Objects are never unpickled, regardless of `weights_only`."""
        return read_checkpoint(Path(path))

    def remove_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """Delete a checkpoint."""
        Path(path).unlink(missing_ok=True)


class SaveLast(Checkpoint):
    """Saves `last.ckpt` after each epoch and its metrics; the checkpoint before it becomes `previous.ckpt`.

    The best checkpoint is kept as `best.ckpt`: the one with the highest `return/acting` of an agent, otherwise the
    highest validation bound or lowest validation loss; of equal ones the first. Without such a metric there is none.

    Lightning's `ModelCheckpoint` stores absolute paths, which break when a run folder is moved.

    Args:
        run: run folder to save to.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run
        self._best: dict[str, Any] = {}  # metric, value and update

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Store the best value so far; as state of the callback, other loops would require it."""
        checkpoint["best"] = self._best

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Restore the best value so far; checkpoints of older versions do not have it."""
        self._best = checkpoint.get("best", {})

    def _compare(self, trainer: Trainer, module: LightningModule) -> None:
        """Update the best value, before the checkpoint is saved."""
        metrics, objective = trainer.callback_metrics, getattr(module, "objective_name", "loss")
        metric = "return/acting" if "return/acting" in metrics else f"val/{objective}"
        value = float(metrics.get(metric, math.nan))
        if not math.isfinite(value):
            return
        best = self._best["value"] if self._best.get("metric") == metric else None
        if best is None or (value < best if objective == "loss" else value > best):
            self._best = {"metric": metric, "value": value, "update": trainer.global_step}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check the free disk space for four checkpoints with weights and Adam's two moments.

        Raises:
            ForbesError: if not even the weights fit once.
        """
        if not trainer.is_global_zero:
            return
        weights = sum(values.numel() * values.element_size() for values in pl_module.state_dict().values())
        missing = 4 - len([*self.run.checkpoint.parent.glob("*.ckpt")])
        require_room(self.run.path, "checkpoints", likely=3 * weights * max(missing, 1), least=weights)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the metrics of the epoch and save. All other callbacks have finished the epoch.

        Lightning counts an epoch that was cut short by `max_steps` or `max_time` as completed, and a resumed run would
        skip its rest. In the checkpoint it is not counted.
        """
        _log_epoch(trainer)
        self._compare(trainer, pl_module)
        missing, epochs = int(not trainer.is_last_batch), cast(Any, trainer.fit_loop.epoch_progress)
        epochs.current.processed -= missing
        epochs.total.processed -= missing
        trainer.save_checkpoint(self.run.checkpoint)
        epochs.current.processed += missing
        epochs.total.processed += missing


def _log_epoch(trainer: Trainer) -> None:
    """Log the metrics of the epoch. Lightning does this after the checkpoint, where a kill would lose them.

    Logged metrics are cleared, so Lightning does not log them again.
    """
    loggers, loop = cast(Any, trainer)._logger_connector, trainer.fit_loop.epoch_loop
    loggers.on_epoch_end()
    loop._batches_that_stepped -= 1  # the index of the last update, as for its own metrics
    loggers.update_train_epoch_metrics()
    loop._batches_that_stepped += 1


class ResumeWholeEpochs(Callback):
    """Lets a training with `max_steps` resume from the end of an epoch.

    If `max_steps` is set, Lightning 2.6 assumes that every checkpoint is from the middle of an epoch, and ends that
    epoch twice. So the limit is removed while the checkpoint is loaded.
    """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remove the limit before the checkpoint is loaded."""
        self._max_steps, trainer.fit_loop.epoch_loop.max_steps = trainer.max_steps, -1

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restore the limit."""
        trainer.fit_loop.epoch_loop.max_steps = self._max_steps


def _is_intact(path: Path) -> bool:
    try:
        verify(path, path.read_bytes())
    except DamagedCheckpointError:
        return False
    return True


def _name_too(path: Path, name: str) -> None:
    """Link a file to a second name in its folder, replacing the file there; copy it where links are not possible."""
    temporary = path.with_name(f".{name}.part")
    temporary.unlink(missing_ok=True)
    try:
        os.link(path, temporary)
    except OSError:  # a file system without hard links
        shutil.copyfile(path, temporary)
    temporary.replace(path.with_name(name))
    temporary.unlink(missing_ok=True)  # the rename has no effect if both names already link to one file
