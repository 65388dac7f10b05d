"""The interface of a format of recorded episodes.

To add a format, copy `dreamer.py`, and name the copy in `FORMATS` of `forbes/choices.py`.
"""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from forbes.envs.images import CHANNELS
from forbes.errors import ForbesError

__all__ = ["Field", "Frames", "Reader", "Recorded", "imported", "within"]

Frames: TypeAlias = NDArray[Any] | Iterable[NDArray[Any]]
"""Values of one key in all steps; images also one by one, so that a decoded video need not fit into memory."""


class Field(NamedTuple):
    """What a format has under one key, per step."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def is_image(self) -> bool:
        """Whether it can be read as an image: uint8, `(H, W)`, or with 1, 3 or 4 channels, first or last."""
        channels = len(self.shape) == 2 or {self.shape[:1], self.shape[-1:]} & {(count,) for count in CHANNELS}
        return self.dtype == np.uint8 and len(self.shape) in (2, 3) and bool(channels)

    @property
    def is_vector(self) -> bool:
        """Whether it is a number or a vector of numbers."""
        return self.dtype.kind in "biuf" and len(self.shape) < 2


class Recorded(NamedTuple):
    """An episode as its format has it."""

    where: str
    """File or group, for messages."""
    values: Mapping[str, Frames]
    """By key. An observation may have one step more than the actions, the last one."""
    terminated: bool
    """Whether the process terminated at the last observation."""


class Reader(ABC):
    """Recorded episodes in some format. An episode is read at a time, by its number, so memory does not grow with them.

    Args:
        path: file or folder.

    Raises:
        ForbesError: if it is damaged, or a library is missing.
    """

    name: ClassVar[str]
    """Name of the format, as in `--format`."""
    actions_lead: ClassVar[bool] = False
    """Whether index t holds the action that led to o_t, as in our store. Otherwise it follows o_t."""
    rewards_lead: ClassVar[bool] = False
    """Whether index t holds the reward that came with o_t, as in our store. Otherwise it came with the next one."""
    actions: ClassVar[tuple[str, ...]] = ("action", "actions")
    """Usual keys of the action."""
    rewards: ClassVar[tuple[str, ...]] = ("reward", "rewards")
    """Usual keys of the reward."""
    observations: ClassVar[tuple[str, ...]] = ()
    """Keys that by convention hold the whole observation."""
    bookkeeping: ClassVar[Collection[str]] = ()
    """Keys that are no observations: ends, times, indices."""
    fps: float | None = None
    """Steps per second, if the format knows them."""
    action_sizes: tuple[int, ...] = ()
    """Number of options of each choice in a discrete action, if the format knows it."""
    note: str = ""
    """What a user should know about this data."""

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether a path looks like this format, without importing a library."""

    @abstractmethod
    def __init__(self, path: Path) -> None: ...

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of episodes."""

    @abstractmethod
    def fields(self) -> dict[str, Field]:
        """Return what there is under each key."""

    @abstractmethod
    def read(self, number: int, keys: Collection[str]) -> Recorded:
        """Read these keys of an episode; others may be left out.

        Raises:
            ForbesError: if they are missing or damaged.
        """


def imported(library: str, extra: str) -> Any:
    """Import a library that is an optional dependency.

    Raises:
        ForbesError: if it is not installed.
    """
    try:
        return importlib.import_module(library)
    except ModuleNotFoundError as error:
        raise ForbesError(
            f"{library} is not installed, and this format needs it. pip install 'forbes[{extra}]'"
        ) from error


def within(folder: Path, name: str, source: Path) -> Path:
    """Return the path of a file that a data set names, which must be inside its folder.

    Args:
        folder: folder of the data set.
        name: relative path.
        source: file that names it, for the message.

    Raises:
        ForbesError: if the path leads out of the folder.
    """
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts:
        raise ForbesError(f"{source}: names the file {name!r}, expected one inside {folder}. Do not trust this data")
    return folder / parts
