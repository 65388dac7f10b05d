"""An episode and its file: an uncompressed `.npz`, which any tool opens with `numpy.load`, and which is mapped here.

A member of an uncompressed archive is an array's bytes at some offset, so a window is read by touching its pages: the
archive is neither copied nor unpacked, and what was read is the system's to forget.
"""

import hashlib
import io
import json
import math
import mmap
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.envs import TIME_LIMIT
from forbes.errors import ForbesError
from forbes.reading import is_number, readable, shortened
from forbes.shapes import printed_by_shape

__all__ = ["DamagedEpisodeError", "Episode", "EpisodeRecord", "map_episode", "pack_episode"]
__all__ += ["problem_of", "problem_with", "read_record"]

_ARRAYS = ("observation", "action", "reward")
_SHOWN = 60  # characters of a wrong value
_LOCAL_HEADER = 30  # bytes before the name of a member of a zip archive


@printed_by_shape
class Episode(NamedTuple):
    """T actions and T + 1 observations. Index t holds (o_t, a_{t-1}, r_t): the action that led there, 0 at the start.

    An episode of three observations, where a1 leads from o1 to o2 and is rewarded by r2::

        observation  o1  o2  o3
        action       0   a1  a2
        reward       0   r2  r3
    """

    observation: NDArray[Any]
    """uint8 `(T + 1, C, H, W)` or float32 `(T + 1, O)`."""
    action: NDArray[np.float32]
    """`(T + 1, A)`, in [-1, 1] or one-hot."""
    reward: NDArray[np.float32]
    """`(T + 1,)`."""
    terminated: bool
    """Whether the process has ended; else a time limit has cut it."""
    frames: int
    """Frames of the simulator, action repeat included: env steps."""

    @property
    def total_reward(self) -> float:
        """The return: the sum of all rewards, without discount."""
        return float(self.reward.sum(dtype="float64"))


_FITS: dict[Any, Callable[[Any], bool]] = {
    int: lambda value: type(value) is int and 0 <= value < 2**63,
    float: lambda value: is_number(value) and -math.inf < value < math.inf,
    bool: lambda value: type(value) is bool,
    str: lambda value: type(value) is str,
    dict[str, Any]: lambda value: type(value) is dict,
}
_SAID: dict[str, Callable[[Any], bool]] = {
    "task": _FITS[str],
    "observation_shape": lambda value: type(value) is list and len(value) in (1, 3) and all(map(_is_size, value)),
    "action_dim": lambda value: _is_size(value),
    "discrete": _FITS[bool],
}
"""What a record must say of its environment, for those who draw from the episodes."""


def _is_size(value: Any) -> bool:
    return _FITS[int](value) and value > 0


class EpisodeRecord(NamedTuple):
    """What the index says of an episode; a line of `index.jsonl`."""

    number: int
    steps: int
    """Agent steps T."""
    frames: int
    """Env steps."""
    total_reward: float
    """The return: the sum of all rewards, without discount."""
    terminated: bool
    seed: int
    """What the environment was reset with."""
    policy: str
    environment: dict[str, Any]
    """Task, shapes and settings; `made_by` has versions and renderer."""
    size: int
    """Bytes of the file."""
    sha256: str
    """Of the file."""

    def problem(self) -> str:
        """Say what is wrong with its values, as in a damaged line of an index; empty where nothing is."""
        for name, kind in type(self).__annotations__.items():
            if not _FITS[kind](value := getattr(self, name)):
                return f"its {name} is {shortened(str(value), _SHOWN)}"
        return "it has no step" if self.steps == 0 else problem_of_environment(self.environment)

    @property
    def settings(self) -> dict[str, Any]:
        """Return what all the episodes of a store must have in common."""
        settings = {"time_limit": TIME_LIMIT} | self.environment  # which records of older versions do not say
        return {name: value for name, value in settings.items() if name != "made_by"}


class DamagedEpisodeError(ForbesError):
    """A file is not what the index says."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: damaged ({reason}). Put it aside with: forbes data check {path.parent}")
        self.reason = reason


def problem_of(episode: Episode) -> str:
    """Say what is wrong with the arrays of an episode; empty where they are whole."""
    count = len(episode.observation)
    for name, dtypes, dimensions in (
        ("observation", ("uint8", "float32"), (2, 4)),
        ("action", ("float32",), (2,)),
        ("reward", ("float32",), (1,)),
    ):
        array: NDArray[Any] = getattr(episode, name)
        if array.dtype not in dtypes or array.ndim not in dimensions or len(array) != count or count < 2:
            return f"its {name} is {array.dtype} {array.shape}, expected {' or '.join(dtypes)} of at least 2 steps"
        if not np.isfinite(array).all():
            return f"its {name} is not finite at step {np.argwhere(~np.isfinite(array))[0, 0]}"
    if episode.action[0].any() or episode.reward[0] != 0:
        return "its first action or reward is not zero, expected at index t the action that led to the observation"
    return ""


def problem_of_environment(environment: dict[str, Any]) -> str:
    """Say what is wrong with what a record says of its environment; empty where nothing is."""
    for name, fits in _SAID.items():
        if name not in environment:
            return f"its environment has no {name}, expected what `describe_environment` gives"
        if not fits(value := environment[name]):
            return f"its environment's {name} is {shortened(str(value), _SHOWN)}"
    return "" if type(environment.get("made_by", {})) is dict else "its environment's made_by is no mapping"


def problem_with(environment: dict[str, Any], episode: Episode) -> str:
    """Say what is wrong with what is recorded of an episode's environment; empty where nothing is."""
    if problem := problem_of_environment(environment):
        return problem
    arrays = {"observation_shape": list(episode.observation.shape[1:]), "action_dim": episode.action.shape[1]}
    for name, found in arrays.items():
        if environment[name] != found:
            return f"its environment's {name} is {environment[name]}, that of its arrays {found}"
    return ""


def pack_episode(episode: Episode, about: dict[str, Any]) -> bytes:
    """Return the content of the file; the same episode gives the same bytes."""
    content = io.BytesIO()
    arrays = {name: getattr(episode, name) for name in _ARRAYS}
    np.savez(content, allow_pickle=False, **arrays, meta=np.array(json.dumps(about)))
    return content.getvalue()


def map_episode(path: Path, record: EpisodeRecord, verify: bool) -> Episode:
    """Open an episode without reading it; its arrays are views of the mapped file, and keep it open.

    Args:
        path: the file.
        record: what the index says of it.
        verify: read it all, and compare the hash and the arrays with what they must be.

    Raises:
        DamagedEpisodeError: where it is not what the record says.
    """
    try:
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if len(mapped) != record.size:
            raise ValueError(f"it has {len(mapped)} bytes, expected {record.size}")
        if verify and hashlib.sha256(mapped).hexdigest() != record.sha256:
            raise ValueError("its sha256 is not that of the index")
        with zipfile.ZipFile(path) as archive:
            observation, action, reward = (_view(mapped, archive.getinfo(f"{name}.npy")) for name in _ARRAYS)
    except FileNotFoundError as error:
        raise DamagedEpisodeError(path, "it is missing") from error
    except (KeyError, ValueError, struct.error, zipfile.BadZipFile) as error:
        raise DamagedEpisodeError(path, str(error.args[0])) from error
    episode = Episode(observation, action, reward, record.terminated, record.frames)
    problem = (verify and problem_of(episode)) or problem_with(record.environment, episode)
    if not problem and len(reward) != record.steps + 1:
        problem = f"it has {len(reward) - 1} steps, expected {record.steps}"
    if problem:
        raise DamagedEpisodeError(path, problem)
    return episode


def read_record(path: Path) -> EpisodeRecord:
    """Read what a whole file says of its own episode.

    Raises:
        ForbesError: where it is damaged, or not a file of `pack_episode`.
    """
    content = path.read_bytes()
    with (
        readable(path, "an episode", "Put it aside"),
        np.load(io.BytesIO(content), allow_pickle=False) as arrays,
    ):
        about = json.loads(arrays["meta"].item())
        record = EpisodeRecord(**about, size=len(content), sha256=hashlib.sha256(content).hexdigest())
    if problem := record.problem():
        raise DamagedEpisodeError(path, problem)
    map_episode(path, record, verify=True)
    return record


def _view(mapped: mmap.mmap, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Find an array's bytes in the archive: behind the member's own header and that of the `.npy` format."""
    if member.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{member.filename} is compressed")
    name_length, extra_length = struct.unpack_from("<HH", mapped, member.header_offset + _LOCAL_HEADER - 4)
    mapped.seek(member.header_offset + _LOCAL_HEADER + name_length + extra_length)
    if np.lib.format.read_magic(mapped) != (1, 0):
        raise ValueError(f"{member.filename} is not of version 1.0 of its format")
    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(mapped)
    if dtype.hasobject or fortran_order:
        raise ValueError(f"{member.filename} holds objects, or columns first")
    return np.frombuffer(mapped, dtype, math.prod(shape), mapped.tell()).reshape(shape)
