"""Export an episode store to formats of other software, without loss."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode
from forbes.data.episodes.store import EpisodeStore
from forbes.data.imports.reader import imported
from forbes.envs.images import CHANNELS
from forbes.errors import ForbesError
from forbes.factors import as_discrete, factor_sizes, to_index
from forbes.files import writing
from forbes.shapes import shape_of

__all__ = ["export_store"]

_RESERVED = ("action", "reward", "discount", "is_first", "is_last", "is_terminal")
"""Keys of Dreamer's files that cannot be names of parts."""
_Add: TypeAlias = Callable[[int, Episode], None]
"""Function that writes an episode, given its number in the export."""


def export_store(store: EpisodeStore, output: Path, name: str) -> Iterator[int]:
    """Export all episodes of a store, and yield the number of each. Importing the result gives the same arrays.

    Args:
        store: the episodes.
        output: file or folder to write. It appears when it is complete.
        name: format, "hdf5" (robomimic's layout), "minari" or "npz" (Dreamer's).

    Raises:
        ForbesError: if an episode is damaged, the output exists or cannot be written, or a library is missing.
    """
    if output.exists():
        raise ForbesError(f"{output}: exists. Choose another name, or delete it")
    shapes = shape_of(_environment(store)["observation_shape"])
    for part, shape in (shapes if isinstance(shapes, dict) else {"": shapes}).items():
        if len(shape) == 3 and shape[0] not in CHANNELS:
            raise ForbesError(f"{store.path}: its images have {shape[0]} channels, expected 1, 3 or 4 to export them")
        if part in _RESERVED:
            raise ForbesError(f"{store.path}: has a part called {part}, which is another key of these formats")
    partial = output.with_name(f"{output.name}.partial")
    partial.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
    with writing(output):
        with _WRITERS[name](store, partial, output.name) as add:
            for number, episode in enumerate(map(store.episode, store.records)):
                add(number, episode)
                yield number
        partial.rename(output)


@contextmanager
def _npz(store: EpisodeStore, path: Path, name: str) -> Iterator[_Add]:
    """Write a folder of `.npz` files as Dreamer does: index t has (o_t, a_{t-1}, r_t)."""
    path.mkdir()

    def add(number: int, episode: Episode) -> None:
        last = np.arange(len(episode.reward)) == len(episode.reward) - 1  # (T + 1,)
        ends = {"is_first": last[::-1], "is_last": last, "is_terminal": last & episode.terminated}
        arrays = {**_observations(episode), "action": episode.action, "reward": episode.reward, **ends}
        discount = (~ends["is_terminal"]).astype(np.float32)
        np.savez_compressed(path / f"{number:06d}-{len(episode.reward)}.npz", discount=discount, **arrays)

    yield add


@contextmanager
def _hdf5(store: EpisodeStore, path: Path, name: str) -> Iterator[_Add]:
    """Write an HDF5 file in robomimic's layout: index t has (o_t, a_t, r_t), and `next_obs` the next observation."""
    with imported("h5py", "hdf5").File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(record.steps for record in store.records.values())
        data.attrs["env_args"] = json.dumps({"env_name": _environment(store)["task"], "type": 2, "env_kwargs": {}})

        def add(number: int, episode: Episode) -> None:
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = len(episode.reward) - 1
            dones = np.zeros(len(episode.reward) - 1, np.uint8)
            dones[-1] = episode.terminated
            arrays: dict[str, Any] = {"dones": dones}
            for key, values in _observations(episode).items():
                arrays |= {f"obs/{key}": values[:-1], f"next_obs/{key}": values[1:]}
            arrays |= {"actions": episode.action[1:], "rewards": episode.reward[1:]}
            for name, array in arrays.items():
                demo.create_dataset(name, data=array, compression="gzip")

        yield add


@contextmanager
def _minari(store: EpisodeStore, path: Path, name: str) -> Iterator[_Add]:
    """Write a Minari data set: T + 1 observations and T actions. Images are stored without JPEG."""
    minari, spaces = imported("minari", "minari"), imported("gymnasium", "minari").spaces
    storage = imported("minari.dataset.minari_storage", "minari").MinariStorage
    buffer = imported("minari.data_collector.episode_buffer", "minari").EpisodeBuffer
    about, first = _environment(store), _observations(store.episode(next(iter(store.records))))
    sizes = factor_sizes(as_discrete(about["discrete"]), about["action_dim"])
    actions = _space_of_actions(store, sizes, spaces)
    folder = (path / "data").absolute()  # the library adds a relative path to itself
    folder.mkdir(parents=True)
    boxes = {key: _box_of(values, spaces) for key, values in first.items()}
    several = isinstance(about["observation_shape"], dict)
    observations = spaces.Dict(boxes) if several else next(iter(boxes.values()))
    data = storage.new(folder, observations, actions, data_format="hdf5", jpeg_encoding=False)
    data_id = f"{re.sub(r'[^-_a-zA-Z0-9]', '_', name)}-v0"
    data.update_metadata({"dataset_id": data_id, "minari_version": minari.__version__})

    def add(number: int, episode: Episode) -> None:
        action: NDArray[Any] = episode.action[1:]  # (T, A)
        if sizes:
            action = to_index(action, sizes).reshape(-1, *actions.shape)  # (T,) or (T, F)
        last = np.arange(len(action)) == len(action) - 1  # (T,)
        ends = {"terminations": last & episode.terminated, "truncations": last & (not episode.terminated)}
        seen = _observations(episode)
        observation = seen if several else next(iter(seen.values()))
        data.update_episodes([buffer(number, None, None, observation, action, episode.reward[1:], **ends)])

    yield add


_WRITERS = {"hdf5": _hdf5, "minari": _minari, "npz": _npz}


def _environment(store: EpisodeStore) -> dict[str, Any]:
    return next(iter(store.records.values())).environment


def _space_of_actions(store: EpisodeStore, sizes: tuple[int, ...], spaces: Any) -> Any:
    """Return the space of actions. A Box is [-1, 1], or unbounded if some are beyond."""
    if sizes:
        return spaces.Discrete(*sizes) if len(sizes) == 1 else spaces.MultiDiscrete(sizes)
    bounded = all(np.abs(store.episode(number).action).max() <= 1 for number in store.records)
    bound = 1.0 if bounded else np.inf
    return spaces.Box(-bound, bound, (_environment(store)["action_dim"],), np.float32)


def _box_of(values: NDArray[Any], spaces: Any) -> Any:
    """Return the space of images or vectors."""
    limits = (0, 255) if values.dtype == np.uint8 else (-np.inf, np.inf)
    return spaces.Box(*limits, values.shape[1:], values.dtype)


def _observations(episode: Episode) -> dict[str, NDArray[Any]]:
    """Return the observations by their usual key, or by part, images with the channel last."""
    parts = episode.observation
    if not isinstance(parts, dict):
        parts = {"image" if parts.ndim == 4 else "vector": parts}
    return {
        name: values.transpose(0, 2, 3, 1) if values.ndim == 4 else values  # (T + 1, H, W, C)
        for name, values in parts.items()
    }
