"""Folders of pictures or videos, with a CSV of the actions of each episode."""

import csv
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from forbes.data.imports.reader import Field, Reader, Recorded
from forbes.data.imports.video import VIDEOS, decoded, frame_rate
from forbes.errors import ForbesError
from forbes.reading import readable

__all__ = ["Frames"]

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
_GREY, _COLOURS = ("1", "L"), ("P", "PA", "LA", "La", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "LAB", "HSV")
"""Modes of pictures of 8 bits; those with more would be cut off at white."""


class Frames(Reader):
    """An episode is a folder of pictures and one `.csv`, or a video and the `.csv` of the same name.

    Pictures are in the order of their names, numbers in them as numbers. The CSV has a line of names, and one line of
    numbers per frame, in which the action follows the frame; that of the last frame may be missing, and if it is there,
    its action leads nowhere and its `terminated` is that of the frame. Columns `reward` and `terminated` are what they
    say, all others are the action.
    """

    name = "frames"
    bookkeeping = ("terminated",)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether there is an episode."""
        return path.is_dir() and bool(_episodes(path))

    def __init__(self, path: Path) -> None:
        self._episodes = _episodes(path)
        if several := [folder for folder in path.iterdir() if folder.is_dir() and len(_tables(folder)) > 1]:
            raise ForbesError(f"{min(several)}: has several .csv, expected one beside its pictures. Move the others")
        first = next((frames for frames, _ in self._episodes), path)
        self.fps = frame_rate(first) if first.is_file() else None

    def __len__(self) -> int:
        return len(self._episodes)

    def fields(self) -> dict[str, Field]:
        """Return what the first episode has."""
        frames, table = self._episodes[0]
        columns = _columns(table)
        image = next(_images(frames))
        found = {"image": Field(image.shape, image.dtype)}
        return found | {name: Field(values.shape[1:], values.dtype) for name, values in columns.items()}

    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read the table of an episode; frames are decoded one by one."""
        frames, table = self._episodes[number]
        columns = _columns(table)
        terminated = columns.get("terminated", np.zeros(1))[-1] == 1
        return Recorded(str(frames), {"image": _images(frames), **columns}, bool(terminated))


def _episodes(path: Path) -> list[tuple[Path, Path]]:
    """Return the frames and the table of each episode: a folder or a video, and a CSV."""
    found = [(video, table) for table in path.glob("*.csv") for video in _videos(table)]
    for folder in path.iterdir():
        if folder.is_dir() and len(tables := _tables(folder)) == 1:
            found.append((folder, tables[0]))
    return sorted(found)


def _tables(folder: Path) -> list[Path]:
    """Return the tables of a folder of pictures; none of another folder."""
    return sorted(folder.glob("*.csv")) if _pictures(folder) else []


def _videos(table: Path) -> list[Path]:
    return [path for suffix in VIDEOS if (path := table.with_suffix(suffix)).is_file()]


def _pictures(folder: Path) -> list[Path]:
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in _PICTURES), key=_numbers_as_numbers)


def _numbers_as_numbers(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts 9.png before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _images(frames: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames of an episode, uint8 `(H, W)` or `(H, W, C)`."""
    if frames.is_file():
        yield from decoded(frames)
        return
    for path in _pictures(frames):
        with readable(path, "a picture", "Repair it"), Image.open(path) as picture:
            if picture.mode not in (*_GREY, *_COLOURS):
                raise ForbesError(f"{path}: its pixels are of mode {picture.mode}, expected 8 bits each. Convert it")
            yield np.asarray(picture.convert("L" if picture.mode in _GREY else "RGB"))


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    """Read a table as the arrays `action`, float64 `(N, A)`, and those of `reward` and `terminated`, `(N,)`."""
    with path.open(newline="", encoding="utf-8-sig") as file:  # Excel begins a file with a mark
        names, *lines = list(csv.reader(file)) or [[]]
    names = [name.strip() for name in names]
    if numbers := [name for name in names if _is_number(name)]:
        raise ForbesError(f"{path}: its first line has the number {numbers[0]}, expected names. Add a line of names")
    for number, line in enumerate(lines, start=2):
        if len(line) != len(names):
            raise ForbesError(f"{path}: line {number} has {len(line)} values, expected {len(names)}")
    values = np.array(lines, dtype=np.float64).reshape(-1, len(names))  # (N, columns)
    known: dict[str, NDArray[Any]] = {
        name: values[:, names.index(name)] for name in ("reward", "terminated") if name in names
    }
    actions = [column for column, name in enumerate(names) if name not in known]
    if not actions:
        raise ForbesError(f"{path}: has no column for the action, expected some besides reward and terminated")
    return known | {"action": values[:, actions]}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
