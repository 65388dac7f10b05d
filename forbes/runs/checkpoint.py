"""Checkpoints that survive a kill at any time: written to a temporary file, verified, then renamed."""

import hashlib
import io
import lzma
import math
import os
import pickle
import shutil
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import CheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint

from forbes.errors import ForbesError
from forbes.files import replace_file, require_room
from forbes.reading import readable
from forbes.runs.folder import RunFolder

__all__ = [
    "AtomicCheckpointIO",
    "CheckpointFile",
    "ResumeWholeEpochs",
    "SaveLast",
    "compressed_checkpoint",
    "open_checkpoint",
    "read_checkpoint",
]


class CheckpointFile(NamedTuple):
    """The content of a checkpoint and its hash."""

    content: dict[str, Any]
    sha256: str
    """SHA-256 of the bytes from which `content` was read. The file may have been replaced since."""


class DamagedCheckpointError(ForbesError):
    """A file is truncated or damaged."""


class UntrustedCheckpointError(ForbesError):
    """A file has other objects than tensors and plain values."""


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
            _verify(path, written.read_bytes())
            if path.name == RunFolder.LAST:
                if checkpoint.get("best", {}).get("update", -1) == checkpoint.get("global_step"):
                    _name_too(written, RunFolder.BEST)
                if path.exists() and _is_intact(path):  # a damaged one must not replace the previous one
                    _name_too(path, RunFolder.PREVIOUS)

        replace_file(path, _sealed(buffer.getvalue()), keep_others)

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


def compressed_checkpoint(content: Mapping[str, Any]) -> bytes:
    """Return the bytes of a checkpoint, compressed by xz. `open_checkpoint` reads it like any other."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    return lzma.compress(_sealed(buffer.getvalue()), filters=[_TWO_BYTE_NUMBERS])


_TWO_BYTE_NUMBERS = {"id": lzma.FILTER_LZMA2, "preset": 9, "lc": 2, "lp": 1, "pb": 1}
"""Filter of xz that models even and odd bytes separately: sign and exponent of a bfloat16, and its mantissa."""
_XZ = b"\xfd7zXZ\0"
_LARGEST = 2**30  # bytes of a decompressed checkpoint


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Verify a checkpoint and return its content on the CPU, as `open_checkpoint` does."""
    return open_checkpoint(path).content


def open_checkpoint(path: Path) -> CheckpointFile:
    """Verify and read a checkpoint to the CPU. The file is read once, so content and hash belong together.

    If `last.ckpt` is damaged, the previous one is read, with a warning on stderr.

    Raises:
        ForbesError: if the file is missing, damaged, or has other objects than tensors and plain values.
    """
    previous = path.with_name(RunFolder.PREVIOUS)
    try:
        return _open(path)
    except DamagedCheckpointError as error:
        if path.name != RunFolder.LAST or not previous.is_file():
            raise
        checkpoint = _open(previous)
        print(f"WARNING: {error}: reading {previous}", file=sys.stderr)
        return checkpoint


def _open(path: Path) -> CheckpointFile:
    if not path.is_file():
        raise ForbesError(f"{path}: no such checkpoint. Train first, or name another run")
    content = path.read_bytes()
    archive = _decompressed(path, content) if content.startswith(_XZ) else content
    _verify(path, archive)
    with readable(path, "a checkpoint", "Take another one", DamagedCheckpointError):
        try:
            checkpoint: dict[str, Any] = torch.load(io.BytesIO(archive), map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            raise UntrustedCheckpointError(
                f"{path}: refused, it has other objects than tensors and plain values. Do not trust it"
            ) from error
    return CheckpointFile(checkpoint, hashlib.sha256(content).hexdigest())


def _decompressed(path: Path, content: bytes) -> bytes:
    """Return the content of an xz file, which is bounded, since a few bytes may become many."""
    xz = lzma.LZMADecompressor(lzma.FORMAT_XZ)
    with readable(path, "a checkpoint", "Take another one", DamagedCheckpointError):
        archive = xz.decompress(content, _LARGEST)
    if not xz.eof:
        raise DamagedCheckpointError(f"{path}: truncated, or more than {_LARGEST >> 30} GiB. Take another one")
    return archive


def _verify(path: Path, content: bytes) -> None:
    """Verify the hash at the end of the file, since torch.load does not detect flipped bits.

    A file without the hash, from an older version or other software, has only the checksums of its members. These do
    not cover the archive's directory, where a flipped bit turns a member into a folder, which torch reads as zeros.
    """
    with (
        readable(path, "a checkpoint", "Take another one", DamagedCheckpointError),
        zipfile.ZipFile(io.BytesIO(content)) as archive,
    ):
        damaged = archive.testzip() or next((m.filename for m in archive.infolist() if m.external_attr & _FOLDER), None)
        whole = not archive.comment or _sealed(content[: -len(archive.comment) - 2] + b"\0\0") == content
    if damaged is not None:
        raise DamagedCheckpointError(
            f"{path}: the checkpoint is damaged (wrong checksum of {damaged}). Take another one"
        )
    if not whole:
        raise DamagedCheckpointError(f"{path}: truncated or damaged (its SHA-256 does not match). Take another one")


_FOLDER = 0x10  # attribute of a member that is a folder
_SEAL = b"sha256 "


def _sealed(content: bytes) -> bytes:
    """Append its own hash to a zip file as the archive's comment. The two bytes before it are the comment's length."""
    begun = content[:-2] + (len(_SEAL) + 64).to_bytes(2, "little") + _SEAL
    return begun + hashlib.sha256(begun).hexdigest().encode()


def _is_intact(path: Path) -> bool:
    try:
        _verify(path, path.read_bytes())
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
