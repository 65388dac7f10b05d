"""The bytes of a checkpoint, with their hash, and what is read from them: tensors and plain values only."""

import hashlib
import io
import lzma
import pickle
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from forbes.errors import ForbesError
from forbes.reading import readable
from forbes.runs.folder import RunFolder

__all__ = [
    "CheckpointFile",
    "DamagedCheckpointError",
    "compressed_checkpoint",
    "open_checkpoint",
    "read_checkpoint",
    "sealed",
    "verify",
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


def compressed_checkpoint(content: Mapping[str, Any]) -> bytes:
    """Return the bytes of a checkpoint, compressed by xz. `open_checkpoint` reads it like any other."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    return lzma.compress(sealed(buffer.getvalue()), filters=[_TWO_BYTE_NUMBERS])


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
    verify(path, archive)
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


def verify(path: Path, content: bytes) -> None:
    """Verify the hash at the end of the file, since torch.load does not detect flipped bits.

    A file without the hash, from an older version or other software, has only the checksums of its members. These do
    not cover the archive's directory, where a flipped bit turns a member into a folder, which torch reads as zeros.
    """
    with (
        readable(path, "a checkpoint", "Take another one", DamagedCheckpointError),
        zipfile.ZipFile(io.BytesIO(content)) as archive,
    ):
        damaged = archive.testzip() or next((m.filename for m in archive.infolist() if m.external_attr & _FOLDER), None)
        whole = not archive.comment or sealed(content[: -len(archive.comment) - 2] + b"\0\0") == content
    if damaged is not None:
        raise DamagedCheckpointError(
            f"{path}: the checkpoint is damaged (wrong checksum of {damaged}). Take another one"
        )
    if not whole:
        raise DamagedCheckpointError(f"{path}: truncated or damaged (its SHA-256 does not match). Take another one")


_FOLDER = 0x10  # attribute of a member that is a folder
_SEAL = b"sha256 "


def sealed(content: bytes) -> bytes:
    """Append its own hash to a zip file as the archive's comment. The two bytes before it are the comment's length."""
    begun = content[:-2] + (len(_SEAL) + 64).to_bytes(2, "little") + _SEAL
    return begun + hashlib.sha256(begun).hexdigest().encode()
