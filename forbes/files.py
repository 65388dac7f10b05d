"""Files that no reader sees half of, folders that no two processes write to, arrays that are stored alike anywhere."""

import fcntl
import io
import os
import platform
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from forbes.errors import ForbesError

__all__ = ["fsync_folder", "locked", "npz_bytes", "replace_file"]


def replace_file(path: Path, content: bytes | memoryview) -> None:
    """Write beside, then rename: the path holds the old content or the new, at every instant and after a power loss."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        fsync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


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
        ForbesError: where another process has it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ForbesError(f"{folder}: {file.read()} {complaint}") from error
        _replace_content(file, f"process {os.getpid()} on {platform.node()}")
        yield


def _replace_content(file: TextIO, content: str) -> None:
    """Write a small file anew without a new inode, which would lose its lock."""
    file.seek(0)
    file.truncate()
    file.write(content)
    file.flush()


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Give the content of a compressed `.npz` file whose bytes depend on the arrays alone.

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
