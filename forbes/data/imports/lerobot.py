"""LeRobot data sets of version 3: parquet files of numbers, mp4 files of cameras; many episodes in a file."""

import io
import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from forbes.data.imports.reader import Field, Frames, Reader, Recorded, imported, within
from forbes.data.imports.video import decoded
from forbes.errors import ForbesError

__all__ = ["LeRobot"]

_INFO = Path("meta/info.json")


class LeRobot(Reader):
    """Index t holds o_t, the action a_t that follows it, and `next.reward`, which follows too.

    Demonstrations end without an observation of their last action, so they count as truncated.
    """

    name = "lerobot"
    rewards = ("next.reward", "reward")
    bookkeeping = ("timestamp", "frame_index", "episode_index", "index", "task_index", "next.done", "next.success")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether it is a folder with `meta/info.json`."""
        return (path / _INFO).is_file()

    def __init__(self, path: Path) -> None:
        self._parquet, self._path = imported("pyarrow.parquet", "lerobot"), path
        self._info = json.loads((path / _INFO).read_text())
        if not (version := str(self._info["codebase_version"])).startswith("v3."):
            raise ForbesError(f"{path / _INFO}: is of version {version}, expected v3. Convert it by lerobot")
        self.fps = float(self._info["fps"])
        files = sorted((path / "meta" / "episodes").glob("*/*.parquet"))
        self._episodes = [row for file in files for row in self._rows(file)]

    def _rows(self, file: Path) -> list[dict[str, Any]]:
        """Return a table of episodes without its statistics."""
        names = [name for name in self._parquet.read_schema(file).names if not name.startswith("stats/")]
        rows: list[dict[str, Any]] = self._parquet.read_table(file, columns=names).to_pylist()
        return rows

    def __len__(self) -> int:
        return len(self._episodes)

    def fields(self) -> dict[str, Field]:
        """Return the features; those of cameras are images."""
        found = {}
        for key, feature in self._info["features"].items():
            dtype = "uint8" if feature["dtype"] in ("video", "image") else feature["dtype"]
            shape = tuple(feature["shape"])
            found[key] = Field(() if shape == (1,) else shape, np.dtype("O" if dtype == "string" else dtype))
        return found

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read the rows of an episode; videos are decoded frame by frame."""
        episode, features = self._episodes[number], self._info["features"]
        path = self._file("data_path", episode, "data")
        columns = [key for key in keys if features[key]["dtype"] != "video"]
        only = [("episode_index", "=", episode["episode_index"])]
        table = self._parquet.read_table(path, columns=columns, filters=only)
        values: dict[str, Frames] = {key: self._column(table[key].to_pylist(), features[key]) for key in columns}
        for key in set(keys) - set(columns):
            video = self._file("video_path", episode, f"videos/{key}", video_key=key)
            values[key] = decoded(video, float(episode[f"videos/{key}/from_timestamp"]), int(episode["length"]))
        where = f"{path}: episode {episode['episode_index']}"
        if columns and len(table) != episode["length"]:
            raise ForbesError(f"{where}: has {len(table)} rows, expected {episode['length']}")
        return Recorded(where, values, terminated=False)

    def _column(self, values: list[Any], feature: dict[str, Any]) -> Frames:
        return _pictures(values) if feature["dtype"] == "image" else np.asarray(values)

    def _file(self, template: str, episode: dict[str, Any], prefix: str, **names: str) -> Path:
        """Return the file of an episode, from the template in `info.json`."""
        place = {name: int(episode[f"{prefix}/{name}"]) for name in ("chunk_index", "file_index")}
        return within(self._path, self._info[template].format(**place, **names), self._path / _INFO)


def _pictures(values: list[Any]) -> Iterator[NDArray[Any]]:
    """Yield the pictures of a column, which are files in the bytes of its values."""
    for value in values:
        with Image.open(io.BytesIO(value["bytes"])) as picture:
            yield np.asarray(picture.convert("RGB"))
