"""Atomic writes, locked folders, and reproducible archives.

Errors when writing, e.g. on a full disk, are one sentence with the name of the file. Symbolic links are not followed,
since a folder may come from an untrusted source.
"""

import errno
import fcntl
import io
import os
import platform
import secrets
import shutil
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.errors import FULL, ForbesError, unwritable

__all__ = ["append_whole", "drop_half_line", "fsync_folder", "locked", "no_link", "npz_bytes", "replace_file"]
__all__ += ["remove_halves", "require_no_links", "require_room", "writing"]


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError while this file is written into one sentence.

    Raises:
        ForbesError: for an OSError inside the `with` block.
    """
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error


def replace_file(
    path: Path, content: bytes | memoryview, verify: Callable[[Path], None] = lambda written: None
) -> None:
    """Replace a file atomically: at any time, even after a power loss, it has its old or its new content.

    Args:
        path: file to write. A symbolic link is replaced, not followed.
        content: new content.
        verify: function of the temporary file, which raises an error to keep the old file.

    Raises:
        ForbesError: if the file cannot be written. The old file, if there is one, is unchanged.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")  # unpredictable, so no link can be placed there
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            verify(temporary)
            temporary.replace(path)
            fsync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def remove_halves(folder: Path, *names: str) -> None:
    """Remove temporary files of `replace_file`, by name or pattern, that a killed process has left.

    Call it only if no other process can be writing these files.
    """
    for name in names:
        for half in folder.glob(f".{name}.*"):
            half.unlink()


def append_whole(path: Path, content: bytes, sync: bool = False) -> None:
    """Append to a file, either all of the content or nothing.

    Args:
        path: file to append to; need not exist.
        content: content to append.
        sync: whether it must survive a power loss.

    Raises:
        ForbesError: if the file cannot be written, or is a symbolic link.
    """
    with writing(path), open(path, "ab", buffering=0, opener=no_link) as file:
        size = file.tell()
        try:
            while content:
                content = content[file.write(content) :]
            if sync:
                os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise
    if sync and size == 0:
        fsync_folder(path.parent)


def drop_half_line(path: Path) -> None:
    """Remove an incomplete last line, left by a killed process."""
    if path.is_file():
        with open(path, "rb+", opener=no_link) as file:
            file.truncate(file.read().rfind(b"\n") + 1)


def no_link(path: str, flags: int) -> int:
    """Open a file without following a symbolic link: `open(path, mode, opener=no_link)`.

    Raises:
        ForbesError: if the path is a symbolic link.
    """
    try:
        return os.open(path, flags | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _is_link(path) from error
        raise


def require_no_links(paths: Iterable[Path]) -> None:
    """Raise a ForbesError if a path is a symbolic link, since data written to it would go elsewhere."""
    for path in paths:
        if path.is_symlink():
            raise _is_link(path)


def _is_link(path: Path | str) -> ForbesError:
    return ForbesError(f"{path}: is a symbolic link, expected a file or folder. Replace it by its target, or delete it")


def require_room(folder: Path, what: str, likely: float, least: float = 0) -> None:
    """Check the free disk space, and warn if the data will probably not fit.

    Args:
        folder: folder to write to.
        what: name of the data for the message, e.g. "checkpoints".
        likely: expected number of bytes.
        least: minimal number of bytes.

    Raises:
        ForbesError: if not even the minimum fits.
    """
    free = shutil.disk_usage(folder).free
    available = f"and {_size(free)} are free. {FULL[errno.ENOSPC]}"
    if free < least:
        raise ForbesError(f"{folder}: {what} take at least {_size(least)}, {available}")
    if free < likely:
        warnings.warn(f"{folder}: {what} will take about {_size(likely)}, {available}", stacklevel=2)


def _size(count: float) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.1f} MiB"


def fsync_folder(folder: Path) -> None:
    """Sync a folder, so that a rename in it survives a power loss."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def locked(folder: Path, complaint: str) -> Iterator[None]:
    """Lock a folder against other processes. The system unlocks it when the process dies.

    Args:
        folder: folder to lock; created if it does not exist.
        complaint: end of the error message after folder and process, e.g. "trains here. …".

    Raises:
        ForbesError: if another process has locked it, or it contains a symbolic link.
    """
    folder.mkdir(parents=True, exist_ok=True)
    require_no_links(folder.rglob("*"))
    with open(folder / ".lock", "ab+", buffering=0, opener=no_link) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ForbesError(f"{folder}: {file.read().decode()} {complaint}") from error
        with writing(folder / ".lock"):  # not `replace_file`, since a new file would not be locked
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}".encode())
        yield


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the content of a compressed `.npz` file whose bytes depend only on the arrays.

    `numpy.savez_compressed` would store the time of writing.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            member.create_system = 3  # Unix, regardless of the system
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
            archive.writestr(member, buffer.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=9)
    return content.getvalue()
