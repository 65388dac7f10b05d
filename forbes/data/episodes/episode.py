"""An episode and its file: an uncompressed `.npz`, readable by `numpy.load`.

A member of an uncompressed archive is the bytes of an array at some offset. A segment is therefore read from the file
without unpacking the archive, and a whole episode is memory-mapped.
"""

import hashlib
import io
import json
import math
import mmap
import os
import struct
import threading
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.fields import FITS, problem_of_environment
from forbes.envs import TIME_LIMIT
from forbes.errors import ForbesError
from forbes.factors import as_discrete, problem_of_choices
from forbes.reading import readable, shortened
from forbes.shapes import NAMES, Observed, is_names, map_parts, printed_by_shape

__all__ = ["DamagedEpisodeError", "Episode", "EpisodeFile", "EpisodeRecord", "Stamp", "locate_episode", "map_episode"]
__all__ += ["arrays_of", "describe_episode", "pack_episode", "problem_of", "problem_with", "read_record", "stamp_of"]

_OBSERVATION = (("|u1", 4), ("<f4", 2))
_KINDS = {"action": (("<f4", 2),), "reward": (("<f4", 1),)}
"""Possible dtypes and numbers of dimensions of an observation or a part of it, and of the other arrays."""
_SHOWN = 60  # characters of an invalid value in an error message
_LOCAL_HEADER = 30  # bytes before the name of a member of a zip archive
_PARSING = threading.Lock()
"""Held while numpy parses a header: in Python 3.11 two threads that parse literals may raise a SystemError."""


@printed_by_shape
class Episode(NamedTuple):
    """T actions and T + 1 observations. Index t has (o_t, a_{t-1}, r_t): the action that led to o_t, 0 at the start.

    An episode of three observations, in which a1 leads from o1 to o2 and earns r2::

        observation  o1  o2  o3
        action       0   a1  a2
        reward       0   r2  r3

    Example:
        >>> observation = torch.tensor([[0.0], [0.5], [0.9]]).numpy()
        >>> action = torch.tensor([[0.0], [0.5], [0.4]]).numpy()  # each observation is the sum of the actions so far
        >>> reward = torch.tensor([0.0, 1.0, 2.0]).numpy()
        >>> forbes.Episode(observation, action, reward, terminated=True, frames=2).total_reward
        3.0
    """

    observation: Observed
    """o_t, uint8 `(T + 1, C, H, W)` or float32 `(T + 1, O)`; of several parts a dict of such arrays by name."""
    action: NDArray[np.float32]
    """a_{t-1}, `(T + 1, A)`, in [-1, 1] or one-hot, see `Environment.discrete`."""
    reward: NDArray[np.float32]
    """r_t, `(T + 1,)`."""
    terminated: bool
    """Whether the process terminated; False if a time limit truncated it."""
    frames: int
    """Number of env steps: frames of the simulator, including action repeat."""

    @property
    def total_reward(self) -> float:
        """Undiscounted return, the sum of all rewards."""
        return float(self.reward.sum(dtype="float64"))


class EpisodeRecord(NamedTuple):
    """The entry of an episode in the index, a line of `index.jsonl`."""

    number: int
    steps: int
    """Number of agent steps, T."""
    frames: int
    """Number of env steps."""
    total_reward: float
    """Undiscounted return, the sum of all rewards."""
    terminated: bool
    seed: int
    """Seed with which the environment was reset."""
    policy: str
    """Name of the policy."""
    environment: dict[str, Any]
    """Task, shapes and settings; `made_by` has versions and renderer."""
    size: int
    """Size of the file in bytes."""
    sha256: str
    """SHA-256 of the file."""

    def problem(self) -> str:
        """Return what is wrong with the values, as in a damaged index, or an empty string."""
        for name, kind in type(self).__annotations__.items():
            if not FITS[kind](value := getattr(self, name)):
                return f"its {name} is {shortened(str(value), _SHOWN)}"
        return "it has no step" if self.steps == 0 else problem_of_environment(self.environment)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that all episodes of a store must have in common."""
        limit = self.environment.get("time_limit", TIME_LIMIT)  # records of older versions have none
        settings = self.environment | {"time_limit": limit}
        return {name: value for name, value in settings.items() if name != "made_by"}


class DamagedEpisodeError(ForbesError):
    """The file of an episode does not match the index."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: damaged ({reason}). Move it to quarantine with: forbes data check {path.parent}")
        self.reason = reason


def arrays_of(episode: Episode) -> dict[str, Any]:
    """Return the arrays of an episode by the names of their members in its file, those of the observation first.

    An observation of several parts has a member for each: `observation/camera`.
    """
    observed: dict[str, Any] = {"observation": episode.observation}
    if isinstance(parts := episode.observation, Mapping):
        observed = {f"observation/{name}": parts[name] for name in sorted(parts)}
    return observed | {"action": episode.action, "reward": episode.reward}


def problem_of(episode: Episode) -> str:
    """Return what is wrong with the arrays of an episode, or an empty string."""
    if isinstance(episode.observation, Mapping) and not is_names(episode.observation):
        return f"its observation has parts named {shortened(str([*episode.observation]), _SHOWN)}, expected {NAMES}"
    arrays = arrays_of(episode)
    count = len(np.atleast_1d(next(iter(arrays.values()))))
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):
            return f"its {name} is a {type(array).__name__}, expected an array"
        expected = _KINDS.get(name, _OBSERVATION)
        if (array.dtype.str, array.ndim) not in expected or not 2 <= len(array) == count:
            kinds = " or ".join(f"{np.dtype(dtype)} of rank {rank}" for dtype, rank in expected)
            return f"its {name} is {array.dtype} {array.shape}, expected {kinds}, with {count} and at least 2 steps"
        if not np.isfinite(array).all():
            return f"its {name} is not finite at step {np.argwhere(~np.isfinite(array))[0, 0]}"
    if episode.action[0].any() or episode.reward[0] != 0:
        return "its first action or reward is not zero, expected index t to have the action that led to o_t"
    return ""


def problem_with(environment: dict[str, Any], episode: Episode) -> str:
    """Return the disagreement between the environment and the arrays of a new episode, or an empty string."""
    if problem := _problem_with_shapes(environment, episode):
        return problem
    return problem_of_choices(episode.action, as_discrete(environment["discrete"]))


def _problem_with_shapes(environment: dict[str, Any], episode: Episode) -> str:
    if problem := problem_of_environment(environment):
        return problem
    shape = map_parts(lambda array: list(array.shape[1:]), episode.observation)
    arrays = {"observation_shape": shape, "action_dim": episode.action.shape[1]}
    for name, found in arrays.items():
        if environment[name] != found:
            return f"its environment's {name} is {environment[name]}, that of its arrays {found}"
    return ""


def describe_episode(
    number: int, episode: Episode, seed: int, policy: str, environment: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of a record that are known before the file, as they will be read from the index.

    Raises:
        ForbesError: if the environment cannot be written as JSON.
    """
    try:
        plain_environment = json.loads(json.dumps(environment, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ForbesError(
            f"episode {number}: its environment is not JSON ({error}). Describe it by plain values"
        ) from error
    return {
        "number": number,
        "steps": len(episode.reward) - 1,
        "frames": _plain(episode.frames),
        "total_reward": episode.total_reward,
        "terminated": _plain(episode.terminated),
        "seed": _plain(seed),
        "policy": policy,
        "environment": plain_environment,
    }


def _plain(value: Any) -> Any:
    """Return a number of NumPy as one of Python, which can be written as JSON."""
    return value.item() if isinstance(value, np.generic) else value


def pack_episode(episode: Episode, about: dict[str, Any]) -> bytes:
    """Return the content of the file. The same episode results in the same bytes."""
    content = io.BytesIO()
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays_of(episode).items()}  # to be mapped
    np.savez(content, allow_pickle=False, **arrays, meta=np.array(json.dumps(about)))
    return content.getvalue()


Stamp: TypeAlias = tuple[int, int, int, int]
"""Bytes, time of the last write, time of the last change, and inode of a file. Every write changes it."""


class StoredArray(NamedTuple):
    """Where an array is in a file."""

    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def view(self, mapped: mmap.mmap) -> NDArray[Any]:
        """Return a view of the mapped file."""
        return np.frombuffer(mapped, self.dtype, math.prod(self.shape), self.offset).reshape(self.shape)


class EpisodeFile(NamedTuple):
    """Where the arrays of an episode are in its file, and when the file was checked."""

    stamp: Stamp
    arrays: tuple[StoredArray, ...]
    """Those of observation (of several parts by name), action and reward."""

    def read(self, file: io.FileIO, start: int, into: Sequence[NDArray[Any]]) -> bool:
        """Read the steps from `start` on into contiguous arrays of the same length, one for each of ours.

        Returns:
            Whether the file had all of them.
        """
        whole = True
        for array, steps in zip(self.arrays, into, strict=True):
            file.seek(array.offset + start * array.dtype.itemsize * math.prod(array.shape[1:]))
            whole &= file.readinto(steps.view(np.uint8).data) == steps.nbytes
        return whole


def stamp_of(file: io.FileIO) -> Stamp:
    """Return the stamp of an open file."""
    found = os.fstat(file.fileno())
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino


def map_episode(path: Path, record: EpisodeRecord, verified: Stamp | None = None) -> Episode:
    """Memory-map an episode. Its arrays are views of the mapped file, and keep it open.

    Args:
        path: file of the episode.
        record: entry of the episode in the index.
        verified: stamp at which the file was last verified. If it has another one, the whole file is read, its hash
            compared, and its arrays checked.

    Raises:
        DamagedEpisodeError: if the file does not match the record.
    """
    return _open_episode(path, record, verified)[1]


def locate_episode(path: Path, record: EpisodeRecord, verified: Stamp | None = None) -> EpisodeFile:
    """Return where the arrays of an episode are, after the checks of `map_episode`."""
    return _open_episode(path, record, verified)[0]


def _open_episode(path: Path, record: EpisodeRecord, verified: Stamp | None) -> tuple[EpisodeFile, Episode]:
    try:
        with open(path, "rb", buffering=0) as file:
            stamp = stamp_of(file)
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if len(mapped) != record.size:
            raise ValueError(f"it has {len(mapped)} bytes, expected {record.size}")
        if stamp != verified and hashlib.sha256(mapped).hexdigest() != record.sha256:
            raise ValueError("its sha256 is not that of the index")
        names = _members(record.environment)
        with zipfile.ZipFile(path) as archive:
            arrays = tuple(_locate(mapped, archive.getinfo(f"{name}.npy")) for name in names)
        *observed, action, reward = (array.view(mapped) for array in arrays)
    except FileNotFoundError as error:
        raise DamagedEpisodeError(path, "it is missing") from error
    except (KeyError, ValueError, struct.error, zipfile.BadZipFile) as error:
        raise DamagedEpisodeError(path, str(error.args[0])) from error
    parts = {name.partition("/")[2]: array for name, array in zip(names, observed, strict=False)}
    episode = Episode(parts.get("", parts), action, reward, record.terminated, record.frames)
    problem = (stamp != verified and problem_of(episode)) or _problem_with_shapes(record.environment, episode)
    if not problem and len(reward) != record.steps + 1:
        problem = f"it has {len(reward) - 1} steps, expected {record.steps}"
    if problem:
        raise DamagedEpisodeError(path, problem)
    return EpisodeFile(stamp, arrays), episode


def _members(environment: dict[str, Any]) -> list[str]:
    """Return the names of the arrays in a file, those of the observation first."""
    shape = environment["observation_shape"]
    parts = [f"observation/{name}" for name in sorted(shape)] if isinstance(shape, dict) else ["observation"]
    return [*parts, "action", "reward"]


def read_record(path: Path) -> EpisodeRecord:
    """Read the record of an episode from its own file, and verify the file.

    Raises:
        ForbesError: if the file is damaged, or was not written by `pack_episode`.
    """
    content = path.read_bytes()
    with (
        readable(path, "an episode", "Move it away"),
        np.load(io.BytesIO(content), allow_pickle=False) as arrays,
    ):
        about = json.loads(arrays["meta"].item())
        record = EpisodeRecord(**about, size=len(content), sha256=hashlib.sha256(content).hexdigest())
    if problem := record.problem():
        raise DamagedEpisodeError(path, problem)
    map_episode(path, record)
    return record


def _locate(mapped: mmap.mmap, member: zipfile.ZipInfo) -> StoredArray:
    """Return where an array of the archive is: after the headers of the member and of the `.npy` format."""
    if member.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{member.filename} is compressed")
    name_length, extra_length = struct.unpack_from("<HH", mapped, member.header_offset + _LOCAL_HEADER - 4)
    mapped.seek(member.header_offset + _LOCAL_HEADER + name_length + extra_length)
    if np.lib.format.read_magic(mapped) != (1, 0):
        raise ValueError(f"{member.filename} is not of version 1.0 of its format")
    with _PARSING:
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(mapped)
    if dtype.hasobject or fortran_order:
        raise ValueError(f"{member.filename} has dtype object or column-major order")
    return StoredArray(mapped.tell(), dtype, shape)
