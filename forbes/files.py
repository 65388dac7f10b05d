"""Files that no reader sees half of, folders that no two processes write to, arrays that are stored alike anywhere.

Where a file cannot be written, as on a full disk, one sentence names it. A folder may come from anywhere. What is
written to it is written there, and not to where a symbolic link in it leads.
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

from forbes.errors import ForbesError, unwritable

__all__ = ["append_whole", "drop_half_line", "fsync_folder", "locked", "no_link", "npz_bytes", "replace_file"]
__all__ += ["remove_halves", "require_no_links", "require_room", "writing"]


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the system says while this file is written into one sentence.

    Raises:
        ForbesError: for an OSError inside.
    """
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error


def replace_file(
    path: Path, content: bytes | memoryview, verify: Callable[[Path], None] = lambda written: None
) -> None:
    """Write a new file next to it, then rename: at every instant and after a power loss, the path is old or new.

    Args:
        path: of the file; a symbolic link is replaced, not followed.
        content: of the new file.
        verify: raises where the new file, which it is given, is not to replace the old one.

    Raises:
        ForbesError: where it cannot be written; the old file, if there is one, is untouched.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")  # nobody can guess it and put a link there
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
    """Remove what `replace_file` has left of files, or of patterns, in a process that was killed.

    Call it where no other process can be writing these files.
    """
    for name in names:
        for half in folder.glob(f".{name}.*"):
            half.unlink()


def append_whole(path: Path, content: bytes, sync: bool = False) -> None:
    """Append to a file, all of it or nothing.

    Args:
        path: of the file; it need not exist.
        content: to append.
        sync: make it survive a power loss, too.

    Raises:
        ForbesError: where it cannot be written, or is a symbolic link.
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
    """Remove what a kill has left of a line at the end of a file, if there is one."""
    if path.is_file():
        with open(path, "rb+", opener=no_link) as file:
            file.truncate(file.read().rfind(b"\n") + 1)


def no_link(path: str, flags: int) -> int:
    """Open a file but not through a symbolic link: `open(path, mode, opener=no_link)`.

    Raises:
        ForbesError: where the path is one.
    """
    try:
        return os.open(path, flags | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _is_link(path) from error
        raise


def require_no_links(paths: Iterable[Path]) -> None:
    """Raise a ForbesError where one of these is a symbolic link: what is written there would go elsewhere."""
    for path in paths:
        if path.is_symlink():
            raise _is_link(path)


def _is_link(path: Path | str) -> ForbesError:
    return ForbesError(
        f"{path}: is a symbolic link, expected what it names itself. Put that in its place, or delete it"
    )


def require_room(folder: Path, what: str, likely: float, least: float = 0) -> None:
    """Compare what will be written with the room on the disk; warn where it will probably not fit.

    Args:
        folder: that it will be written to.
        what: it is, for the sentence: "checkpoints".
        likely: bytes that it will probably take.
        least: bytes that it will take for certain.

    Raises:
        ForbesError: where not even the least of it fits.
    """
    free = shutil.disk_usage(folder).free
    there = f"and {_size(free)} are free. Make room, or choose another place"
    if free < least:
        raise ForbesError(f"{folder}: {what} take at least {_size(least)}, {there}")
    if free < likely:
        warnings.warn(f"{folder}: {what} will take about {_size(likely)}, {there}", stacklevel=2)


def _size(count: float) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.1f} MiB"


def fsync_folder(folder: Path) -> None:
    """Make a rename in this folder survive a power loss."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def locked(folder: Path, complaint: str) -> Iterator[None]:
    """Keep every other process from working in this folder; the system frees it when the process dies.

    Args:
        folder: made where it does not exist.
        complaint: what is said where another process has it, after the folder and the process: "trains here. …".

    Raises:
        ForbesError: where another process has it, or a symbolic link is in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    require_no_links(folder.rglob("*"))
    with open(folder / ".lock", "ab+", buffering=0, opener=no_link) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ForbesError(f"{folder}: {file.read().decode()} {complaint}") from error
        with writing(folder / ".lock"):  # not a new file, which would not be locked
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}".encode())
        yield


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the content of a compressed `.npz` file whose bytes depend on the arrays alone.

    `numpy.savez_compressed` would stamp the members with the time of writing.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            member.create_system = 3  # Unix, also where this runs on Windows
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
            archive.writestr(member, buffer.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=9)
    return content.getvalue()
