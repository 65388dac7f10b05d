"""HDF5 files of arrays of all steps of all episodes, as in D4RL, with flags or positions where episodes end."""

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.data.imports.hdf5 import datasets, has_signature, open_hdf5
from forbes.data.imports.reader import Field, Reader, Recorded
from forbes.errors import ForbesError

__all__ = ["Arrays"]

_AT_ANY_END = ("dones", "done")
"""Names of flags that are often set at a time limit too."""
_TERMINATED = ("terminals", "terminations", "terminated", *_AT_ANY_END)
_TRUNCATED = ("timeouts", "truncations", "truncated", "is_last")
_POSITIONS = ("episode_ends", "meta/episode_ends")


class Arrays(Reader):
    """Index t holds (o_t, a_t, r_t). The last observation is in `next_observations`, if the file has it.

    Ends are flags (`terminals` and `timeouts`, or other usual names) at the last step of an episode, or numbers of
    steps up to the end of each (`episode_ends`). Steps after the last flag are an episode that was truncated. `dones`
    end an episode, and terminate it if there are no `terminals` and it is not marked as truncated.
    """

    name = "arrays"
    observations = ("observations", "observation", "obs")
    bookkeeping = (*_TERMINATED, *_TRUNCATED, *_POSITIONS, "next_observations", "next_observation", "next_obs")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is an HDF5 file."""
        return has_signature(path)

    def __init__(self, path: Path) -> None:
        self._path = path
        arrays = dict(datasets(open_hdf5(path)))
        flags = [name for name in (*_TERMINATED, *_TRUNCATED) if name in arrays]
        positions: Any = next((arrays[name][:] for name in _POSITIONS if name in arrays), None)
        if not flags and positions is None:
            expected = ", ".join((*_TERMINATED, *_TRUNCATED, *_POSITIONS))
            raise ForbesError(f"{path}: nothing says where episodes end, expected one of {expected}")
        steps = len(arrays[flags[0]]) if flags else int(positions[-1])
        for name in (*self.observations, *self.actions, *self.rewards):
            if name in arrays and len(arrays[name]) != steps:
                raise ForbesError(
                    f"{path}: {name} has {len(arrays[name])} steps, expected {steps}, since episodes end there"
                )
        self._arrays = {name: array for name, array in arrays.items() if array.shape[:1] == (steps,)}
        truncated = _flags(self._arrays, _TRUNCATED, steps)
        if positions is None:
            positions = np.flatnonzero(_flags(self._arrays, _TERMINATED, steps) | truncated) + 1
        told = next((name for name in _TERMINATED if name in self._arrays), None)
        self._terminals = _flags(self._arrays, [told] if told else [], steps)
        if told in _AT_ANY_END:
            self._terminals &= ~truncated
        ends = np.union1d(positions, [steps]) if flags else positions  # steps after the last flag are an episode, too
        starts = np.concatenate([[0], ends[:-1]])
        if (ends <= starts).any():
            raise ForbesError(f"{path}: the ends of its episodes do not increase")
        long = ends - starts > (0 if any(map(self._after, self.observations)) else 1)
        self._bounds = np.stack([starts, ends], axis=1)[long]  # (E, 2)
        if not long.all():
            self.note = f"{np.sum(~long)} episodes of a single observation are left out"

    def _after(self, key: str) -> Any:
        """Return the array of the observations that follow those of a key, if there is one."""
        return self._arrays.get(f"next_{key}")

    def __len__(self) -> int:
        return len(self._bounds)

    def fields(self) -> dict[str, Field]:
        """Return the arrays with a value per step."""
        return {name: Field(array.shape[1:], array.dtype) for name, array in self._arrays.items()}

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read the steps of an episode."""
        start, end = self._bounds[number].tolist()
        values = {key: self._arrays[key][start:end] for key in keys}
        observed = [key for key in keys if key not in (*self.actions, *self.rewards)]
        after = {key: found[end - 1 : end] for key in observed if (found := self._after(key))}
        values |= {key: np.concatenate([values[key], after[key]]) for key in after}
        terminated = bool(after) and bool(self._terminals[end - 1])
        return Recorded(f"{self._path}: steps {start} to {end - 1}", values, terminated)


def _flags(arrays: dict[str, Any], names: Iterable[str], steps: int) -> NDArray[np.bool_]:
    """Return where any of these arrays is set, `(N,)`."""
    found = [arrays[name][:].reshape(steps).astype(bool) for name in names if name in arrays]
    flags: NDArray[np.bool_] = np.logical_or.reduce([np.zeros(steps, bool), *found])
    return flags
