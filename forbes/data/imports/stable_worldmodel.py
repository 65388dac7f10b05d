"""HDF5 files of stable-worldmodel: a column per key of all steps, and the length of each episode."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from forbes.data.imports.hdf5 import datasets, has_signature, open_hdf5
from forbes.data.imports.reader import Field, Reader, Recorded, imported
from forbes.errors import ForbesError

__all__ = ["StableWorldModel"]


class StableWorldModel(Reader):
    """Index t holds o_t, the action a_t that follows it, and the reward that came with it.

    Its recorder moves the actions one step ahead, but not the rewards; the last action of an episode has no meaning. An
    episode terminated if its last `terminated` is true.
    """

    name = "stable-worldmodel"
    rewards_lead = True
    bookkeeping = ("ep_len", "ep_offset", "terminated", "truncated", "ep_idx", "episode_idx", "step_idx", "seed", "id")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is an HDF5 file with `ep_len` and `ep_offset`."""
        return has_signature(path) and {"ep_len", "ep_offset"} <= set(imported("h5py", "hdf5").File(path, "r"))

    def __init__(self, path: Path) -> None:
        self._path, file = path, open_hdf5(path)
        self._columns = {name: array for name, array in datasets(file) if name not in ("ep_len", "ep_offset")}
        self._starts, lengths = file["ep_offset"][:].astype(int), file["ep_len"][:].astype(int)  # (E,), (E,)
        self._ends = self._starts + lengths
        steps = min(map(len, self._columns.values()))
        if (self._starts < 0).any() or (lengths < 2).any() or (self._ends > steps).any():
            raise ForbesError(f"{path}: ep_offset and ep_len say up to step {self._ends.max()}, but there are {steps}")

    def __len__(self) -> int:
        return len(self._starts)

    def fields(self) -> dict[str, Field]:
        """Return the columns."""
        return {name: Field(column.shape[1:], column.dtype) for name, column in self._columns.items()}

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read the steps of an episode."""
        steps = slice(self._starts[number], self._ends[number])
        values = {key: self._columns[key][steps] for key in keys}
        last = self._columns.get("terminated", np.zeros(steps.stop))[steps.stop - 1]
        return Recorded(f"{self._path}: episode {number}", values, terminated=bool(np.any(last)))
