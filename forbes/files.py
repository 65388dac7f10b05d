"""Files that a reader never sees half of, and arrays whose file depends on nothing else."""

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["npz_bytes", "replace_file"]


def replace_file(path: Path, content: bytes) -> None:
    """Write beside, then rename: the path holds the old content or the new, at every instant."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


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
