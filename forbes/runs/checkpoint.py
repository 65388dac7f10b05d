"""Checkpoints that survive a kill at any instant: written beside, verified, then renamed over the old one."""

import hashlib
import io
import math
import os
import pickle
import shutil
import sys
import zipfile
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
    "open_checkpoint",
    "read_checkpoint",
]


class CheckpointFile(NamedTuple):
    """A checkpoint as it was read."""

    content: dict[str, Any]
    sha256: str
    """Of the bytes that `content` was read from: the file may hold others by now."""


class DamagedCheckpointError(ForbesError):
    """A file is not what was written."""


class UntrustedCheckpointError(ForbesError):
    """A file holds more than tensors and plain values."""


class AtomicCheckpointIO(CheckpointIO):
    """Holds, at every instant, nothing or a whole checkpoint at the path; loads only tensors and plain values.

    Lightning's own writes to the system's temporary folder, from where the file is copied over the old checkpoint,
    and a full disk leaves half of it.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write another file in the same folder, verify it, and rename it to `path`."""
        path = Path(path)
        buffer = io.BytesIO()  # written to a full disk directly, torch.save fails without saying why
        torch.save(checkpoint, buffer)

        def keep_others(written: Path) -> None:
            _verify(path, written.read_bytes())
            if path.name == RunFolder.LAST:
                if checkpoint.get("best", {}).get("update", -1) == checkpoint.get("global_step"):
                    _name_too(written, RunFolder.BEST)
                if path.exists() and _is_whole(path):  # one that is not is worth less than the one before it
                    _name_too(path, RunFolder.PREVIOUS)

        replace_file(path, _sealed(buffer.getvalue()), keep_others)

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU; never unpickles objects, whatever `weights_only` says."""
        return read_checkpoint(Path(path))

    def remove_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """Delete a checkpoint."""
        Path(path).unlink(missing_ok=True)


class SaveLast(Checkpoint):
    """Saves after each epoch, whose metrics are logged before; the checkpoint before becomes `previous.ckpt`.

    The best one stays as `best.ckpt`: that with the highest `return/acting` of an agent, otherwise with the highest
    bound of the validation, or its lowest loss. Of equals it is the first. A run that measures neither has none.

    Lightning's `ModelCheckpoint` remembers where it saved, and is lost in a run folder that was moved.

    Args:
        run: where the checkpoint goes.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run
        self._best: dict[str, Any] = {}  # metric, value and update

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Write into a checkpoint which is the best up to it; as state of a callback, other loops would ask for it."""
        checkpoint["best"] = self._best

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Go on from there; an older version did not write it."""
        self._best = checkpoint.get("best", {})

    def _compare(self, trainer: Trainer, module: LightningModule) -> None:
        """Note whether the checkpoint that follows is the best."""
        metrics, objective = trainer.callback_metrics, getattr(module, "objective_name", "loss")
        metric = "return/acting" if "return/acting" in metrics else f"val/{objective}"
        value = float(metrics.get(metric, math.nan))
        if not math.isfinite(value):
            return
        best = self._best["value"] if self._best.get("metric") == metric else None
        if best is None or (value < best if objective == "loss" else value > best):
            self._best = {"metric": metric, "value": value, "update": trainer.global_step}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Estimate the room: weights and Adam's two moments, of the last, the previous, the best and a new checkpoint.

        Raises:
            ForbesError: where not even the weights fit once.
        """
        weights = sum(values.numel() * values.element_size() for values in pl_module.state_dict().values())
        missing = 4 - len([*self.run.checkpoint.parent.glob("*.ckpt")])
        require_room(self.run.path, "checkpoints", likely=3 * weights * max(missing, 1), least=weights)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the metrics of the epoch and save; every other callback has ended its epoch.

        Lightning counts an epoch that `max_steps` or `max_time` has cut short as done, and a resumed run would miss the
        rest of it. In the checkpoint it is not.
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
    """Log what the epoch has measured, as Lightning does after the checkpoint, where a kill would lose it.

    What is logged is forgotten, so that Lightning then has nothing to log.
    """
    loggers, loop = cast(Any, trainer)._logger_connector, trainer.fit_loop.epoch_loop
    loggers.on_epoch_end()
    loop._batches_that_stepped -= 1  # the index of the last update, as for its own metrics
    loggers.update_train_epoch_metrics()
    loop._batches_that_stepped += 1


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

    Where `last.ckpt` is damaged, the one before it is read, and stderr says so.

    Raises:
        ForbesError: when the file is missing, damaged, or holds more than tensors and plain values.
    """
    previous = path.with_name(RunFolder.PREVIOUS)
    try:
        return _open(path)
    except DamagedCheckpointError as error:
        if path.name != RunFolder.LAST or not previous.is_file():
            raise
        found = _open(previous)
        print(f"WARNING: {error}: reading {previous}", file=sys.stderr)
        return found


def _open(path: Path) -> CheckpointFile:
    if not path.is_file():
        raise ForbesError(f"{path}: no such checkpoint. Train first, or name another run")
    content = path.read_bytes()
    _verify(path, content)
    with readable(path, "a checkpoint", "Take another one", DamagedCheckpointError):
        try:
            checkpoint: dict[str, Any] = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            raise UntrustedCheckpointError(
                f"{path}: refused, it holds more than tensors and plain values. Do not trust it"
            ) from error
    return CheckpointFile(checkpoint, hashlib.sha256(content).hexdigest())


def _verify(path: Path, content: bytes) -> None:
    """Compare the file with its seal; torch.load itself reads flipped bits without a word.

    A file without one, of an older version or other software, has the checksums of its members. They leave out the
    directory, where a flipped bit makes a member a folder, of which torch reads zeros.
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
        raise DamagedCheckpointError(
            f"{path}: truncated or damaged (its SHA-256 is not what it says). Take another one"
        )


_FOLDER = 0x10  # of the attributes of a member
_SEAL = b"sha256 "


def _sealed(content: bytes) -> bytes:
    """Append the hash of a zip file to it, as the archive's comment, whose length are the last two bytes before."""
    begun = content[:-2] + (len(_SEAL) + 64).to_bytes(2, "little") + _SEAL
    return begun + hashlib.sha256(begun).hexdigest().encode()


def _is_whole(path: Path) -> bool:
    try:
        _verify(path, path.read_bytes())
    except DamagedCheckpointError:
        return False
    return True


def _name_too(path: Path, name: str) -> None:
    """Name a file a second time in its folder, in place of the file with that name; copy it where links are unknown."""
    aside = path.with_name(f".{name}.part")
    aside.unlink(missing_ok=True)
    try:
        os.link(path, aside)
    except OSError:  # a file system without hard links
        shutil.copyfile(path, aside)
    aside.replace(path.with_name(name))
    aside.unlink(missing_ok=True)  # a rename does nothing where both are names of one file already
