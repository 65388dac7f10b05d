"""Folders of `.npz` files, an episode each, as Dreamer, DreamerV2 and V-D4RL write them."""

import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np

from forbes.data.imports.reader import Field, Reader, Recorded
from forbes.errors import ForbesError

__all__ = ["Dreamer"]


class Dreamer(Reader):
    """Index t holds (o_t, a_{t-1}, r_t), as in our store: Dreamer starts an episode with a zero action.

    An episode terminated if its last `is_terminal` is true; in files without it, if its last `discount` is 0. Files are
    read in the order of their names, which begin with a time.
    """

    name = "dreamer"
    actions_lead = rewards_lead = True
    bookkeeping = ("discount", "is_first", "is_last", "is_terminal", "reset", "terminal", "step_type")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is a folder of `.npz` files."""
        return path.is_dir() and any(path.glob("*.npz"))

    def __init__(self, path: Path) -> None:
        self._files = sorted(path.glob("*.npz"))

    def __len__(self) -> int:
        return len(self._files)

    def fields(self) -> dict[str, Field]:
        """Return what the first file has, from the headers of its arrays."""
        found = {}
        with zipfile.ZipFile(self._files[0]) as archive:
            for name in archive.namelist():
                with archive.open(name) as member:
                    version = np.lib.format.read_magic(member)
                    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
                    shape, _, dtype = read[version](member)
                found[name.removesuffix(".npy")] = Field(shape[1:], dtype)
        return found

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read the arrays of a file."""
        path = self._files[number]
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:  # numpy would leave it open
            values = {key: arrays[key] for key in keys if key in arrays}
            if "is_first" in arrays and arrays["is_first"][1:].any():
                raise ForbesError(
                    f"{path}: has several episodes, expected one per file. Split it where is_first is true"
                )
            ends = arrays["is_terminal"] if "is_terminal" in arrays else 1 - arrays.get("discount", np.ones(1))
        return Recorded(str(path), values, terminated=bool(ends[-1] == 1))
