"""Lance tables of stable-worldmodel: a row per step, images as JPEG, vectors of float32."""

import io
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from forbes.data.imports.reader import Field, Reader, Recorded, imported
from forbes.errors import ForbesError

__all__ = ["Lance"]

_EPISODE = "episode_idx"


class Lance(Reader):
    """Index t holds o_t, the action a_t that follows it, and the reward that came with it, as in its HDF5 files."""

    name = "lance"
    rewards_lead = True
    bookkeeping = (_EPISODE, "step_idx", "ep_idx", "terminated", "truncated", "seed", "id")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is a table, or a folder with one."""
        return path.is_dir() and (path.suffix == ".lance" or len([*path.glob("*.lance")]) == 1)

    def __init__(self, path: Path) -> None:
        self._path = path if path.suffix == ".lance" else next(path.glob("*.lance"))
        self._data = imported("lance", "lance").dataset(str(self._path))
        index = self._data.to_table(columns=[_EPISODE])[_EPISODE].to_numpy()  # (rows,)
        if (np.diff(index) < 0).any():
            raise ForbesError(f"{path}: the rows of an episode are not together, expected {_EPISODE} to increase")
        ends = np.flatnonzero(np.diff(index, append=index[-1:] + 1)) + 1  # (E,)
        self._bounds = np.stack([np.concatenate([[0], ends[:-1]]), ends], axis=1)  # (E, 2)

    def __len__(self) -> int:
        return len(self._bounds)

    def fields(self) -> dict[str, Field]:
        """Return what the columns of the first row have."""
        first = self._data.take([0]).to_pylist()[0]
        found = {
            key: next(_pictures([value])) if isinstance(value, bytes) else _row(value) for key, value in first.items()
        }
        return {key: Field(value.shape, value.dtype) for key, value in found.items()}

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read the rows of an episode; images are decoded one by one."""
        start, end = self._bounds[number].tolist()
        ended = ["terminated"] if "terminated" in self._data.schema.names else []
        rows = self._data.take(range(start, end), columns=[*keys, *ended]).to_pydict()
        values = {key: _pictures(rows[key]) if isinstance(rows[key][0], bytes) else _stack(rows[key]) for key in keys}
        terminated = bool(ended) and bool(np.any(rows["terminated"][-1]))
        return Recorded(f"{self._path}: episode {number}", values, terminated)


def _row(value: Any) -> NDArray[Any]:
    array = np.asarray(value, np.float32 if isinstance(value, list) else None)
    return array.reshape(()) if array.size == 1 else array


def _stack(values: list[Any]) -> NDArray[Any]:
    return np.asarray(values, np.float32 if isinstance(values[0], list) else None)


def _pictures(values: list[bytes]) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures, uint8 `(H, W, 3)`, from their files' bytes."""
    for value in values:
        with Image.open(io.BytesIO(value)) as picture:
            yield np.asarray(picture.convert("RGB"))
