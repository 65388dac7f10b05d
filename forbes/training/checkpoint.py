"""Checkpoints that survive a kill at any instant: written beside, verified, then renamed over the old one."""

import hashlib
import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import CheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint

from forbes.errors import ForbesError
from forbes.files import fsync_folder
from forbes.reading import readable
from forbes.training.run_folder import RunFolder

__all__ = [
    "AtomicCheckpointIO",
    "CheckpointFile",
    "ResumeWholeEpochs",
    "SaveLast",
    "open_checkpoint",
    "read_checkpoint",
]


class CheckpointFile(NamedTuple):
    """A checkpoint as it was read."""

    content: dict[str, Any]
    sha256: str
    """Of the bytes that `content` was read from: the file may hold others by now."""


class AtomicCheckpointIO(CheckpointIO):
    """Holds, at every instant, nothing or a whole checkpoint at the path; loads only tensors and plain values.

    Lightning's own writes to the system's temporary folder, from where the file is copied over the old checkpoint,
    and a full disk leaves half of it.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write a temporary file in the same folder, verify it, and rename it to `path`."""
        path = Path(path)
        temporary = path.with_name(f".{path.name}.part")
        content = io.BytesIO()  # written to a full disk directly, torch.save fails without saying why
        torch.save(checkpoint, content)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("wb") as file:
                file.write(content.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            _verify(path, temporary.read_bytes())
            temporary.replace(path)
            fsync_folder(path.parent)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise ForbesError(
                f"{path}: the checkpoint cannot be written ({error.strerror}), the one before it is untouched. "
                "Make room or choose another --run_dir"
            ) from error

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU; never unpickles objects, whatever `weights_only` says."""
        return read_checkpoint(Path(path))

    def remove_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """Delete a checkpoint."""
        Path(path).unlink(missing_ok=True)


class SaveLast(Checkpoint):
    """Saves after each epoch, over the checkpoint before.

    Lightning's `ModelCheckpoint` remembers where it saved, and is lost in a run folder that was moved.

    Args:
        run: where the checkpoint goes.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save; every other callback has ended its epoch.

        Lightning counts an epoch that `max_steps` or `max_time` has cut short as done, and a resumed run would miss the
        rest of it. In the checkpoint it is not.
        """
        missing, epochs = int(not trainer.is_last_batch), cast(Any, trainer.fit_loop.epoch_progress)
        epochs.current.processed -= missing
        epochs.total.processed -= missing
        trainer.save_checkpoint(self.run.checkpoint)
        epochs.current.processed += missing
        epochs.total.processed += missing


class ResumeWholeEpochs(Callback):
    """Lets a training with `max_steps` go on from the end of an epoch.

    Lightning 2.6 takes every checkpoint for one of the middle of an epoch where `max_steps` is set, and ends that epoch
    twice. So the limit is out of its sight while it loads the checkpoint.
    """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the limit away; the checkpoint is loaded next."""
        self._max_steps, trainer.fit_loop.epoch_loop.max_steps = trainer.max_steps, -1

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set it again."""
        trainer.fit_loop.epoch_loop.max_steps = self._max_steps


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint; see `open_checkpoint`."""
    return open_checkpoint(path).content


def open_checkpoint(path: Path) -> CheckpointFile:
    """Verify and read a checkpoint to the CPU. The file is read once, so that content and hash belong together.

    Raises:
        ForbesError: when the file is missing, damaged, or holds more than tensors and plain values.
    """
    if not path.is_file():
        raise ForbesError(f"{path}: no such checkpoint. Train first, or name another run")
    content = path.read_bytes()
    _verify(path, content)
    with readable(path, "a checkpoint", "Take another one"):
        try:
            checkpoint: dict[str, Any] = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            raise ForbesError(
                f"{path}: refused, it holds more than tensors and plain values. Do not trust it"
            ) from error
    return CheckpointFile(checkpoint, hashlib.sha256(content).hexdigest())


def _verify(path: Path, content: bytes) -> None:
    """Compare every checksum in the file; torch.load itself reads flipped bits without a word."""
    with readable(path, "a checkpoint", "Take another one"), zipfile.ZipFile(io.BytesIO(content)) as archive:
        damaged = archive.testzip()
    if damaged is not None:
        raise ForbesError(f"{path}: the checkpoint is damaged (wrong checksum of {damaged}). Take another one")
