"""Recorded episodes as episodes of our store: index t has (o_t, a_{t-1}, r_t)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode, problem_of
from forbes.data.imports.keys import choose_keys
from forbes.data.imports.reader import Frames, Reader, Recorded
from forbes.envs.images import to_image
from forbes.errors import ForbesError
from forbes.factors import are_one_hot, as_plain, described_sizes, discrete_of, to_one_hot
from forbes.reading import readable
from forbes.shapes import Observed, Shape, map_parts, plain_shape

__all__ = ["REMEDY", "Source"]

REMEDY = "Repair it or leave it out, and run the same command again"
_MOST = 10_000  # numbers of a discrete action, A; larger integers are something else


class _Steps(NamedTuple):
    """An episode in numbers, before it is shifted."""

    observation: Observed
    """Every k-th one, uint8 `(n, C, H, W)` or float32 `(n, O)`, or these by part."""
    observed: int
    """Number of observations, N."""
    action: NDArray[Any]
    """`(N, ...)`, or one fewer."""
    reward: NDArray[np.float32]


class Source:
    r"""The episodes of a reader, converted one at a time.

    A format that has (o_t, a_t, r_t) at index t, where a_t is chosen after o_t and earns r_t, is shifted::

        theirs   o1  o2  o3        ours   o1  o2  o3
                 a1  a2  a3               0   a1  a2
                 r1  r2  r3               0   r1  r2

    The last action and its reward are dropped, unless the format has the observation after them.

    Args:
        reader: the recorded episodes.
        path: file or folder, for messages and as the name of the task.
        images: keys of images of the observation.
        proprio: keys of vectors of the observation, which are concatenated. With images, or of several images, the
            observation has parts.
        action: key of the action. Integers become one-hot vectors, one each.
        reward: key of the reward. Without one, rewards are 0.
        resize: side of the images in pixels.
        fps: steps per second to keep. The k actions of a kept step are joined, its rewards summed.
        action_sizes: number of options of each choice in a discrete action. Default: what the format knows; of
            integers, one more than the highest; of one-hot vectors, their length.

    Raises:
        ForbesError: if there are no episodes, a key is wrong, or the first episode is damaged.
    """

    def __init__(
        self,
        reader: Reader,
        path: Path,
        images: Sequence[str] = (),
        proprio: Sequence[str] = (),
        action: str | None = None,
        reward: str | None = None,
        resize: int | None = None,
        fps: float | None = None,
        action_sizes: Sequence[int] = (),
    ) -> None:
        self.reader, self.path, self.resize = reader, path, resize
        self.drops_last = False
        if len(reader) == 0:
            raise ForbesError(f"{path}: there are no episodes. Name another file or folder")
        with readable(path, reader.name, REMEDY):
            self.fields = reader.fields()
        self.keys = choose_keys(str(path), reader, self.fields, images, proprio, action, reward)
        self.every = self._every(fps)
        self.sizes, self.counted = self._kind_of_actions(tuple(action_sizes) or reader.action_sizes)
        self.discrete = discrete_of(self.sizes)
        if self.discrete and self.every > 1:
            raise ForbesError(f"{path}: --fps {fps} would join {self.every} discrete actions. Keep all steps")
        self.first = self.episode(0)

    def __len__(self) -> int:
        return len(self.reader)

    def describe(self) -> dict[str, Any]:
        """Return the environment for the record of an episode: the name of the source, shapes, and the conversion."""
        return {
            "task": self.path.resolve().name,
            "observation_shape": plain_shape(_shape(self.first.observation)),
            "action_dim": self.first.action.shape[1],
            "discrete": as_plain(self.discrete),
            "action_repeat": self.every,
            "imported": {"format": self.reader.name, "resize": self.resize, "keys": self.keys.all()},
        }

    def episode(self, number: int) -> Episode:
        """Read and convert an episode.

        Raises:
            ForbesError: if it is damaged, or its shapes are not those of the first one.
        """
        recorded, steps = self._load(number)
        episode = self._align(recorded, steps)
        problem, first = problem_of(episode), getattr(self, "first", episode)
        for name in ("observation", "action"):
            found, expected = (_shape(getattr(each, name)) for each in (episode, first))
            if not problem and found != expected:
                problem = f"its {name} has shape {found}, expected that of the first episode, {expected}"
        if not problem and self.sizes and not are_one_hot(episode.action[1:], self.sizes):
            problem = f"its actions are not {described_sizes(self.sizes)}"
        if problem:
            raise ForbesError(f"{recorded.where}: {problem}. {REMEDY}")
        return episode

    def _load(self, number: int) -> tuple[Recorded, _Steps]:
        """Read an episode, and decode its images."""
        with readable(f"{self.path}: episode {number}", self.reader.name, REMEDY):
            recorded = self._read(number, self.keys.all())
            action = _numbers(recorded, self.keys.action)  # (N, ...)
            reward = np.zeros(len(action), np.float32)  # (N,)
            if self.keys.reward is not None:
                reward = _float32(_numbers(recorded, self.keys.reward))
                reward = reward.reshape(len(reward), -1).sum(1)  # (N,)
            parts = {name: self._part(recorded, keys) for name, keys in self.keys.parts().items()}
            lengths = {name: count for name, (_, count) in parts.items()}
            if len({*lengths.values()}) > 1:
                raise ForbesError(f"{recorded.where}: unequal lengths: {lengths}. {REMEDY}")
        observed = {name: values for name, (values, _) in parts.items()}
        observation = observed if len(observed) > 1 else next(iter(observed.values()))
        return recorded, _Steps(observation, next(iter(lengths.values())), action, reward)

    def _part(self, recorded: Recorded, keys: Sequence[str]) -> tuple[NDArray[Any], int]:
        """Return every k-th image or vector of a part, the last one included, and the number of all."""
        if keys[0] in self.keys.images:
            return self._images(recorded, recorded.values[keys[0]])  # (n, C, H, W)
        vectors = [_float32(_numbers(recorded, key)) for key in keys]
        count = len(vectors[0])
        if len(lengths := {len(vector) for vector in vectors}) > 1:
            raise ForbesError(f"{recorded.where}: unequal lengths of {self.keys.proprio}: {lengths}. {REMEDY}")
        joined = np.concatenate([vector.reshape(count, -1) for vector in vectors], axis=1)  # (N, O)
        return joined[(count - 1) % self.every :: self.every], count  # (n, O)

    def _read(self, number: int, keys: list[str]) -> Recorded:
        recorded = self.reader.read(number, keys)
        for key in keys:
            if key not in recorded.values:
                raise ForbesError(f"{recorded.where}: has no {key}, unlike other episodes. {REMEDY}")
        return recorded

    def _images(self, recorded: Recorded, frames: Frames) -> tuple[NDArray[np.uint8], int]:
        """Return every k-th image, `(n, C, H, W)`, and the number of all."""
        images = []
        for frame in frames:
            if frame.dtype != np.uint8:
                raise ForbesError(f"{recorded.where}: its image has dtype {frame.dtype}, expected uint8. {REMEDY}")
            images.append(to_image(frame, self.resize))
        count = len(images)
        return np.stack(images[(count - 1) % self.every :: self.every]), count

    def _align(self, recorded: Recorded, steps: _Steps) -> Episode:
        """Shift actions and rewards to the observation that they led to, and join those of skipped steps."""
        reader, (observation, count, action, reward) = self.reader, steps
        shift_allowed = 0 if reader.actions_lead or reader.rewards_lead else 1
        if len(reward) != len(action) or not 0 <= count - len(action) <= shift_allowed:
            raise ForbesError(
                f"{recorded.where}: unequal lengths: {count} observations, {len(action)} actions, {len(reward)} "
                f"rewards. {REMEDY}"
            )
        if reader.actions_lead and not self.counted and action[0].any():
            raise ForbesError(
                f"{recorded.where}: its first action is not zero, expected index t to have the action that led to "
                f"o_t. {REMEDY}"
            )
        self.drops_last = shift_allowed == 1 and count == len(action)
        if self.drops_last and recorded.terminated and reward[-1] != 0:
            raise ForbesError(
                f"{recorded.where}: its last line has a reward and is terminated, but no observation follows it. Add "
                "that observation, or remove the line"
            )
        kept = (count - 1) // self.every  # T
        used, end = kept * self.every, count - 1
        action = (action[1:] if reader.actions_lead else action)[end - used : end]  # (kT, ...)
        action = self._vectors(recorded, action)  # (kT, A)
        reward = (reward[1:] if reader.rewards_lead else reward)[end - used : end]  # (kT,)
        return Episode(
            observation=observation,  # (T + 1, ...)
            action=_after_zero(action.reshape(kept, self.every * action.shape[1])),  # (T + 1, kA)
            reward=_after_zero(reward.reshape(kept, self.every).sum(1)),  # (T + 1,)
            terminated=bool(recorded.terminated),
            frames=used,
        )

    def _vectors(self, recorded: Recorded, action: NDArray[Any]) -> NDArray[np.float32]:
        """Return actions as vectors, `(N, A)`."""
        action = action.reshape(len(action), -1)  # (N, F) or (N, A)
        if not self.counted:
            return _float32(action)  # (N, A)
        if not np.array_equal(action, np.round(action)) or action.shape[1] != len(self.sizes):  # floats in a CSV
            found = f"{action.dtype} {action.shape[1:]}"
            raise ForbesError(
                f"{recorded.where}: its actions are {found}, expected {len(self.sizes)} integers. {REMEDY}"
            )
        for number, size in zip(action.astype(np.int64).T, self.sizes, strict=True):  # (N,)
            if number.size and not 0 <= number.min() <= number.max() < size:
                raise ForbesError(
                    f"{recorded.where}: its actions are {number.min()} to {number.max()}, expected 0 to {size - 1}. "
                    f"{REMEDY}"
                )
        return to_one_hot(action.astype(np.int64), self.sizes)  # (N, A)

    def _kind_of_actions(self, sizes: tuple[int, ...]) -> tuple[tuple[int, ...], bool]:
        """Return the sizes of the one-hot vectors in an action, none for vectors; and whether integers stand for them.

        Args:
            sizes: those that are known; empty if they are not.
        """
        where, (shape, dtype) = f"{self.path}: {self.keys.action}", self.fields[self.keys.action]
        columns, whole = int(np.prod(shape, dtype=int)), dtype.kind in "biu"
        if sizes:
            if columns in (len(sizes), sum(sizes)):
                return sizes, columns != sum(sizes)
            expected = f"{len(sizes)} integers, or {described_sizes(sizes)}"
            raise ForbesError(f"{where} is {dtype} {shape}, expected {expected}. Change --action or --action-sizes")
        if columns > 1 and self._seem_one_hot(columns):
            return (columns,), False
        if not whole:
            return (), False
        highest = [self._actions(number).max(0, initial=1) for number in range(len(self))]  # (F,) each
        sizes = tuple((1 + np.max(highest, axis=0, initial=1).astype(int)).tolist())
        if sum(sizes) > _MOST:
            raise ForbesError(f"{where} has integers up to {max(sizes) - 1}, expected discrete actions")
        return sizes, True

    def _seem_one_hot(self, columns: int) -> bool:
        """Return whether the actions of all episodes are one-hot vectors."""
        certain = slice(None) if self.reader.actions_lead else slice(-1)  # the last one may be no action
        any_rows = False
        for number in range(len(self)):
            rows = self._actions(number)[certain]  # (N, F)
            if len(rows) and not are_one_hot(rows, (columns,)):
                return False
            any_rows |= len(rows) > 0
        return any_rows

    def _actions(self, number: int) -> NDArray[Any]:
        """Return the actions of an episode, `(N, F)`, without the first one if it led to the first observation."""
        with readable(f"{self.path}: episode {number}", self.reader.name, REMEDY):
            action = _numbers(self._read(number, [self.keys.action]), self.keys.action)
            action = action.reshape(len(action), -1)  # (N, F)
        if action.shape[1:] != (np.prod(self.fields[self.keys.action].shape, dtype=int),):
            raise ForbesError(
                f"{self.path}: episode {number}: {self.keys.action} has {action.shape[1]} numbers a step, unlike that "
                f"of the first episode. {REMEDY}"
            )
        return action[1:] if self.reader.actions_lead else action

    def _every(self, fps: float | None) -> int:
        """Return k: one of k steps is kept."""
        if fps is None:
            return 1
        if self.reader.fps is None:
            raise ForbesError(
                f"{self.path}: --fps {fps:g} needs the rate of the data, which {self.reader.name} has not"
            )
        every = round(self.reader.fps / fps)
        if every < 1 or abs(self.reader.fps / fps - every) > 0.01 * every:
            raise ForbesError(f"{self.path}: --fps {fps:g} does not divide the {self.reader.fps:g} steps per second")
        return every


def _shape(values: Observed) -> Shape:
    shape: Shape = map_parts(lambda array: array.shape[1:], values)
    return shape


def _numbers(recorded: Recorded, key: str) -> NDArray[Any]:
    array = np.asarray(recorded.values[key])
    if array.dtype.kind not in "biuf" or not array.ndim:
        raise ForbesError(f"{recorded.where}: {key} is {array.dtype} {array.shape}, expected numbers. {REMEDY}")
    return array


def _float32(values: NDArray[Any]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # the result is infinite, and refused
        converted: NDArray[np.float32] = values.astype(np.float32)
    return converted


def _after_zero(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Prepend a zero: nothing led to the first observation."""
    return np.concatenate([np.zeros_like(values[:1], shape=(1, *values.shape[1:])), values])  # (T + 1, ...)
