"""What the readers of HDF5 files share: open one by h5py, and refuse files that point to other files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from forbes.data.imports.reader import imported
from forbes.errors import ForbesError

__all__ = ["datasets", "has_signature", "open_hdf5"]

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def has_signature(path: Path) -> bool:
    """Return whether a path is a file that begins as HDF5 does."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def open_hdf5(path: Path) -> Any:
    """Open a file by h5py for reading.

    Raises:
        ForbesError: if h5py is not installed, or the file takes data from other files, which it could be any.
        OSError: if it is damaged.
    """
    h5py = imported("h5py", "hdf5")
    file = h5py.File(path, "r")

    def outside(name: str, link: Any) -> str | None:
        """Return the name of what is in another file; the visit ends there."""
        away = isinstance(link, h5py.ExternalLink)
        if isinstance(link, h5py.HardLink) and isinstance(found := file[name], h5py.Dataset):
            away = found.is_virtual or found.external is not None
        return name if away else None

    if name := file.visititems_links(outside):
        raise ForbesError(f"{path}: {name} is in another file, expected one file. Do not trust this data")
    return file


def datasets(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the arrays of a group and of the groups in it, with their names."""
    for name in group:
        if hasattr(group[name], "dtype"):
            yield prefix + name, group[name]
        else:
            yield from datasets(group[name], f"{prefix}{name}/")
