"""Minari data sets (Farama Foundation), read by its library: a local folder, or an id in its own folder."""

import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from forbes.data.imports.hdf5 import open_hdf5
from forbes.data.imports.reader import Field, Reader, Recorded, imported
from forbes.errors import ForbesError

__all__ = ["Minari"]


class Minari(Reader):
    """T + 1 observations and T actions: a_t follows o_t. Parts of a Dict or Tuple have keys like `a/b`, others one key.

    An episode terminated if its last `terminations` is true. The library opens the file for every episode.
    """

    name = "minari"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is the folder of a data set, or its `data`."""
        return (_data(path) / "metadata.json").is_file()

    def __init__(self, path: Path) -> None:
        minari = imported("minari", "minari")
        if not path.exists():
            path = Path(minari.storage.local.get_dataset_path(str(path)))
        self._path = _data(path)
        about = json.loads((self._path / "metadata.json").read_text())
        if not {"observation_space", "action_space"} <= set(about):  # the library would import what env_spec names
            raise ForbesError(f"{self._path}: metadata.json has no spaces, expected observation_space and action_space")
        if about["data_format"] == "hdf5":
            open_hdf5(self._path / "main_data.hdf5").close()
        self._data = minari.MinariDataset(self._path)
        from forbes.envs.gymnasium_spaces import factors, first_option, require_actions

        require_actions(str(self._path), self._data.action_space, "Record a data set with one of them")
        self.action_sizes = factors(self._data.action_space)
        self._first_option = first_option(self._data.action_space)

    def __len__(self) -> int:
        return len(self._data)

    def fields(self) -> dict[str, Field]:
        """Return what the first episode has."""
        first = self.read(0, ()).values
        return {
            key: Field(array.shape[1:], array.dtype) for key, array in first.items() if isinstance(array, np.ndarray)
        }

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read an episode with all of its keys, which the library does not read apart."""
        episode = self._data[number]
        actions = np.asarray(episode.actions)
        if self.action_sizes:
            actions = actions - self._first_option
        values = dict(_parts(episode.observations)) | {"action": actions, "reward": episode.rewards}
        return Recorded(f"{self._path}: episode {number}", values, terminated=bool(episode.terminations[-1]))


def _data(path: Path) -> Path:
    """Return the folder with the metadata of a data set: itself, or `data` in it."""
    return path if (path / "metadata.json").is_file() else path / "data"


def _parts(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the arrays in nested mappings and tuples."""
    if isinstance(value, Mapping | tuple):
        for key, part in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _parts(part, f"{name}/{key}" if name else str(key))
    else:
        yield name or "observation", value
