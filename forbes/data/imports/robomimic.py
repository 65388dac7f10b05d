"""HDF5 files of robomimic: a group `data/demo_N` per episode, with `obs`, `actions`, `rewards` and `dones`."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from forbes.data.imports.hdf5 import has_signature, open_hdf5
from forbes.data.imports.reader import Field, Reader, Recorded, imported

__all__ = ["Robomimic"]


class Robomimic(Reader):
    """Index t holds (o_t, a_t, r_t). The last observation is in `next_obs`, if the file has it.

    With `next_obs`, an episode terminated if its last `dones` is true; robomimic also sets it where a demonstration
    merely ends. Keys of observations are those of `obs`.
    """

    name = "robomimic"
    bookkeeping = ("dones", "states")
    note = "dones[-1] counts as termination, if next_obs has the observation after it"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is an HDF5 file with a group `data`."""
        return has_signature(path) and "data" in imported("h5py", "hdf5").File(path, "r")

    def __init__(self, path: Path) -> None:
        self._path, self._data = path, open_hdf5(path)["data"]
        self._demos = sorted(self._data, key=lambda name: (len(name), name))  # demo_10 after demo_9

    def __len__(self) -> int:
        return len(self._demos)

    def fields(self) -> dict[str, Field]:
        """Return what the first episode has."""
        demo = self._data[self._demos[0]]
        arrays = {name: demo[name] for name in demo if hasattr(demo[name], "dtype")} | dict(demo["obs"].items())
        return {name: Field(array.shape[1:], array.dtype) for name, array in arrays.items()}

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read a group."""
        demo = self._data[self._demos[number]]
        after, values, followed = demo.get("next_obs", {}), {}, False
        for key in keys:
            if key in demo["obs"]:
                values[key] = demo["obs"][key][:]
                if key in after:
                    values[key], followed = np.concatenate([values[key], after[key][-1:]]), True
            elif key in demo:
                values[key] = demo[key][:]
        terminated = followed and "dones" in demo and bool(demo["dones"][-1])
        return Recorded(f"{self._path}: data/{self._demos[number]}", values, terminated)
