"""Stored episodes as data: windows of fixed length, mapped from the disk."""

import hashlib
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forbes.data.episodes.episode import EpisodeRecord
from forbes.data.episodes.store import EpisodeStore, first_held
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.errors import ForbesError, require_at_least
from forbes.seeding import generator
from forbes.shapes import printed_by_shape

__all__ = ["Replay", "Segments"]


@printed_by_shape
class Segments(NamedTuple):
    """Some windows as they are stored."""

    observation: Tensor
    """o_t, uint8 (B, T, C, H, W) or float32 (B, T, O); 0 on padding."""
    action: Tensor
    """a_{t-1}, float32 (B, T, A)."""
    reward: Tensor
    """r_t, float32 (B, T)."""
    mask: Tensor
    """False on padding, bool (B, T)."""
    ended: Tensor
    """True on the last step of an episode that a process has ended, bool (B, T)."""


class _Table(NamedTuple):
    """The episodes of a split."""

    numbers: list[int]
    lengths: Tensor
    """Observations of each, int64 (E,)."""
    ends: Tensor
    """How many windows begin in this episode or an earlier one, int64 (E,)."""


class Replay(SequenceSource):
    r"""Windows of the episodes of a store (`forbes data collect`), which may grow meanwhile.

    A training batch is uniform over episodes, then over the starts of windows that fit into the episode:

    .. math:: e \sim U\{1, \dots, E\}, \qquad k \sim U\{0, \dots, \max(0, n_e - T)\}, \qquad (o_{k+1}, \dots, o_{k+T})

    so no window crosses episodes, and the last of an episode's :math:`n_e` observations is drawn as often as the first.
    Batch i is a pure function of (seed, i, the episodes held). Held-out windows start at every `stride`-th observation.
    A window that its episode does not fill is padded; one that starts within an episode has the action that led there.

    Of ten episodes, the ninth is of the validation split and the tenth of the test split (number mod `hold_out`).

    Args:
        path: the folder of the store.
        capacity: agent steps of the latest episodes that are held; None holds all. The files stay.
        hold_out: one episode in so many is of each held-out split; 0 gives all to the training.
        stride: observations between the starts of held-out windows.

    Raises:
        ForbesError: where the store is empty or its index damaged, or a number is not what it can be.

    Example:
        >>> source = forbes.Replay("episodes/tiger")  # forbes data collect --task tiger --episodes 20 -o episodes/tiger
        >>> data = forbes.SequenceDataModule(source, length=10)
        >>> data.sequences("train", torch.arange(3)).reward.shape
        torch.Size([3, 10])
    """

    def __init__(self, path: str, capacity: int | None = None, hold_out: int = 10, stride: int = 50) -> None:
        if capacity is not None and capacity < 1:
            raise ForbesError(f"Replay: capacity is {capacity}, expected at least 1 step, or null for all")
        if hold_out != 0 and hold_out < 3:
            raise ForbesError(f"Replay: hold_out is {hold_out}, expected 0 or at least 3. Choose another")
        require_at_least(1, "Replay", stride=stride)
        self.path, self.capacity, self.hold_out, self.stride = path, capacity, hold_out, stride
        self.store = EpisodeStore(path)
        self.store.require_episodes()
        self._watermark = self.store.watermark
        environment = next(iter(self.store.records.values())).environment
        self.observation_shape: tuple[int, ...] = tuple(environment["observation_shape"])
        self.action_dim: int = environment["action_dim"]
        self.discrete: bool = environment["discrete"]

    def refresh(self) -> None:
        """See the episodes that were added or set aside since; what is held changes here and nowhere else."""
        self.store.refresh()
        self.watermark = self.store.watermark

    @property
    def watermark(self) -> int:
        """How many episodes had ever been stored when it last looked; later ones are not seen."""
        return self._watermark

    @watermark.setter
    def watermark(self, value: int) -> None:
        if value > self.store.watermark:
            raise ForbesError(
                f"{self.path}: has {self.store.watermark} episodes, expected the {value} of the checkpoint. "
                "Name the folder that was trained on"
            )
        self._watermark = value
        self.__dict__.pop("_tables", None)

    def _held(self) -> list[EpisodeRecord]:
        seen = [record for number, record in self.store.records.items() if number < self._watermark]
        first = first_held(seen, self.capacity)
        return [record for record in seen if record.number >= first]

    @cached_property
    def _tables(self) -> dict[Split, _Table]:
        held: dict[Split, list[int]] = {"train": [], "validation": [], "test": []}
        for record in self._held():
            held[self.split_of(record.number)].append(record.number)
        return {split: self._table(numbers, self._stride(split)) for split, numbers in held.items()}

    def _table(self, numbers: list[int], stride: int) -> _Table:
        lengths = torch.tensor([self.store.records[number].steps + 1 for number in numbers], dtype=torch.int64)
        return _Table(numbers, lengths, (-(-lengths // stride)).cumsum(0))  # (E,), (E,)

    def _stride(self, split: Split) -> int:
        return 1 if split == "train" else self.stride

    def split_of(self, number: int) -> Split:
        """Return the split of an episode; it depends on its number only, so it never changes."""
        if self.hold_out == 0 or (place := self.hold_out - 1 - number % self.hold_out) > 1:
            return "train"
        return "validation" if place else "test"

    def sha256(self) -> str:
        """Hash the episodes held, by their hashes."""
        return hashlib.sha256(" ".join(record.sha256 for record in self._held()).encode()).hexdigest()

    def size(self, split: Split) -> int:
        """Count the windows of a split: of the training those from every observation, else from every `stride`-th."""
        ends = self._tables[split].ends
        return int(ends[-1]) if len(ends) else 0

    def train_index(self, batch_size: int, length: int, seed: int, update: int) -> Tensor:
        """Draw the windows of one training batch, int64 `(B,)`, with replacement."""
        table = self._require("train")
        draw = generator(seed, "replay", update)
        episode = torch.randint(len(table.numbers), (batch_size,), generator=draw)  # (B,)
        starts = (table.lengths[episode] - length + 1).clamp(min=1)  # (B,), how many there are
        start = (torch.rand(batch_size, generator=draw, dtype=torch.float64) * starts).long()  # (B,)
        return (table.ends - table.lengths)[episode] + start  # a training window begins at every observation

    def latest(self, count: int) -> Tensor:
        """Return the windows that the newest episodes begin with, the newest first, int64 `(count,)` or fewer."""
        table = self._require("train")
        return (table.ends - table.lengths).flip(0)[:count]  # a training window begins at every observation

    def gather(self, split: Split, index: Tensor, length: int) -> Segments:
        """Copy windows by index, int64 (B,), from the mapped files."""
        require_at_least(1, "Replay", length=length)
        table, count, stride = self._require(split), len(index), self._stride(split)
        row = torch.searchsorted(table.ends, index, right=True)  # (B,)
        windows = -(-table.lengths // stride)  # (E,)
        start = stride * (index - (table.ends - windows)[row])  # (B,)
        dtype = np.uint8 if len(self.observation_shape) == 3 else np.float32
        observation = np.zeros((count, length, *self.observation_shape), dtype)
        action = np.zeros((count, length, self.action_dim), np.float32)
        reward, mask = np.zeros((count, length), np.float32), np.zeros((count, length), bool)
        ended = np.zeros((count, length), bool)
        for window, (place, begin) in enumerate(zip(row.tolist(), start.tolist(), strict=True)):
            episode = self.store.episode(table.numbers[place])
            end = min(begin + length, len(episode.reward))
            steps, there = slice(begin, end), slice(0, end - begin)
            observation[window, there] = episode.observation[steps]
            action[window, there], reward[window, there] = episode.action[steps], episode.reward[steps]
            mask[window, there] = True
            ended[window, end - begin - 1] = episode.terminated and end == len(episode.reward)
        return Segments(*map(torch.from_numpy, (observation, action, reward, mask, ended)))

    def decode(self, compact: Segments) -> SequenceBatch:
        """Add the state, which is not known."""
        observation, action, reward, mask, ended = compact
        return SequenceBatch(observation, action, reward, mask, reward.new_zeros(*reward.shape, 0), ended)

    def _require(self, split: Split) -> _Table:
        """Return a split that has episodes."""
        table = self._tables[split]
        if not table.numbers:
            raise ForbesError(
                f"{self.path}: no episode is of the split {split}, expected one of {self.hold_out}. Collect more, or "
                "choose a smaller hold_out"
            )
        return table
