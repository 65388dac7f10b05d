"""Stored episodes as training data: segments of fixed length."""

import hashlib
from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from forbes.data.episodes.episode import EpisodeRecord
from forbes.data.episodes.index import first_held
from forbes.data.episodes.store import EpisodeStore
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.errors import ForbesError, require_at_least
from forbes.factors import Discrete, as_discrete
from forbes.seeding import generator
from forbes.shapes import Observed, Shape, map_parts, printed_by_shape, shape_of

__all__ = ["Replay", "Segments"]


@printed_by_shape
class Segments(NamedTuple):
    """Segments of episodes as they are stored."""

    observation: Observed
    """o_t, uint8 (B, T, C, H, W) or float32 (B, T, O), or a dict of them by part; 0 on padding."""
    action: Tensor
    """a_{t-1}, float32 (B, T, A)."""
    reward: Tensor
    """r_t, float32 (B, T)."""
    mask: Tensor
    """False on padding, bool (B, T)."""
    ended: Tensor
    """True on the last step of an episode that terminated, bool (B, T)."""

    @classmethod
    def unwritten(cls, count: int, length: int, observation_shape: Shape, action_dim: int) -> "Segments":
        """Return segments to be written to: their values are arbitrary, their masks False."""

        def observations(shape: tuple[int, ...]) -> Tensor:
            return torch.empty(count, length, *shape, dtype=torch.uint8 if len(shape) == 3 else torch.float32)

        return cls(
            observation=map_parts(observations, observation_shape),
            action=torch.empty(count, length, action_dim),
            reward=torch.empty(count, length),
            mask=torch.zeros(count, length, dtype=torch.bool),
            ended=torch.zeros(count, length, dtype=torch.bool),
        )

    def begin(self, row: int, steps: int, ends: bool) -> list[NDArray[Any]]:
        """Mark the first steps of a segment as steps and the others as padding.

        Args:
            row: number of the segment.
            steps: number of its steps.
            ends: whether the episode terminates with the last one.

        Returns:
            Observation, action and reward of the steps, as arrays to write to; several parts by name.
        """
        parts = self.observation
        observed = [parts[name] for name in sorted(parts)] if isinstance(parts, dict) else [parts]
        stored = (*observed, self.action, self.reward)
        for values in stored:
            values[row, steps:] = 0
        self.mask[row, :steps] = True
        self.ended[row, steps - 1] = ends
        return [values[row, :steps].numpy() for values in stored]


class _Table(NamedTuple):
    """The episodes of a split."""

    numbers: list[int]
    lengths: Tensor
    """Number of observations of each episode, int64 (E,)."""
    ends: Tensor
    """Number of segments that begin in this episode or an earlier one, int64 (E,)."""


class Replay(SequenceSource):
    r"""Segments of the episodes of a store (`forbes data collect`), which may grow at the same time.

    A training batch is uniform over episodes, then over the starts of segments that fit into the episode:

    .. math:: e \sim U\{1, \dots, E\}, \qquad k \sim U\{0, \dots, \max(0, n_e - T)\}, \qquad (o_{k+1}, \dots, o_{k+T})

    so no segment crosses episodes, and the last of the :math:`n_e` observations of an episode is sampled as often as
    the first. Batch i is a pure function of (seed, i, the episodes held). Held-out segments start at every `stride`-th
    observation; a rest of fewer than `stride` begins none, unless it is a whole episode. A segment is padded if its
    episode is too short. If it starts within an episode, its first action is the one that led there.

    Of ten episodes, the ninth is in the validation split and the tenth in the test split (number mod `hold_out`).

    Args:
        path: folder of the store.
        capacity: maximal number of agent steps to sample from, the latest; None for all. No file is deleted.
        hold_out: each held-out split has one episode out of `hold_out`; 0 uses all episodes for training.
        stride: number of observations between the starts of held-out segments.

    Raises:
        ForbesError: if the store is empty or its index damaged, or an argument is out of range.

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
        self._verified: set[Split] = set()
        environment = next(iter(self.store.records.values())).environment
        self.observation_shape = shape_of(environment["observation_shape"])
        self.action_dim: int = environment["action_dim"]
        self.discrete: Discrete = as_discrete(environment["discrete"])

    def refresh(self) -> None:
        """Read the index again. The episodes to sample from change only here."""
        self.store.refresh()
        self.watermark = self.store.watermark

    @property
    def watermark(self) -> int:
        """Number of episodes ever stored at the last `refresh`. Later ones are ignored."""
        return self._watermark

    @watermark.setter
    def watermark(self, value: int) -> None:
        if value > self.store.watermark:
            raise ForbesError(
                f"{self.path}: has {self.store.watermark} episodes, expected the {value} of the checkpoint. "
                "Name the folder used in training"
            )
        self._watermark = value
        self._verified.clear()
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
        return _Table(numbers, lengths, _num_segments(lengths, stride).cumsum(0))  # (E,), (E,)

    def _stride(self, split: Split) -> int:
        return 1 if split == "train" else self.stride

    def split_of(self, number: int) -> Split:
        """Return the split of an episode. It depends only on its number, so it never changes."""
        if self.hold_out == 0 or (from_end := self.hold_out - 1 - number % self.hold_out) > 1:
            return "train"
        return "validation" if from_end else "test"

    def sha256(self) -> str:
        """Hash the episodes to sample from, by their hashes."""
        return hashlib.sha256(" ".join(record.sha256 for record in self._held()).encode()).hexdigest()

    def size(self, split: Split) -> int:
        """Return the number of segments: one per observation in training, else one per `stride` of an episode."""
        ends = self._tables[split].ends
        return int(ends[-1]) if len(ends) else 0

    def train_index(self, batch_size: int, length: int, seed: int, update: int) -> Tensor:
        """Sample the segments of one training batch with replacement, int64 `(B,)`."""
        table = self._require("train")
        draw = generator(seed, "replay", update)
        episode = torch.randint(len(table.numbers), (batch_size,), generator=draw)  # (B,)
        starts = (table.lengths[episode] - length + 1).clamp(min=1)  # (B,), number of possible starts
        start = (torch.rand(batch_size, generator=draw, dtype=torch.float64) * starts).long()  # (B,)
        return (table.ends - table.lengths)[episode] + start  # a training segment begins at every observation

    def latest(self, count: int) -> Tensor:
        """Return the first segments of the newest episodes, the newest first, int64 `(count,)` or fewer."""
        table = self._require("train")
        return (table.ends - table.lengths).flip(0)[:count]  # a training segment begins at every observation

    def gather(self, split: Split, index: Tensor, length: int) -> Segments:
        """Return segments by index, int64 (B,). Before the first one, the files of the split are verified."""
        require_at_least(1, "Replay", length=length)
        if split not in self._verified:
            self.store.verify(self._require(split).numbers)
            self._verified.add(split)
        segments = Segments.unwritten(len(index), length, self.observation_shape, self.action_dim)
        for row, (number, start) in enumerate(self._locate(split, index)):
            record = self.store.records[number]
            end = min(start + length, record.steps + 1)
            ends = record.terminated and end == record.steps + 1
            self.store.read(number, start, segments.begin(row, end - start, ends))
        return segments

    def episodes(self, split: Split, index: Tensor) -> list[int] | None:
        """See `SequenceSource.episodes`."""
        found = [number for number, _ in self._locate(split, index)]
        return None if len({*found}) == len(found) else found

    def _locate(self, split: Split, index: Tensor) -> Iterator[tuple[int, int]]:
        """Yield the number of the episode and the start of each segment."""
        table, stride = self._require(split), self._stride(split)
        row = torch.searchsorted(table.ends, index, right=True)  # (B,)
        before = table.ends - _num_segments(table.lengths, stride)  # (E,), segments of earlier episodes
        start = stride * (index - before[row])  # (B,)
        return zip((table.numbers[episode] for episode in row.tolist()), start.tolist(), strict=True)

    def decode(self, compact: Segments) -> SequenceBatch:
        """Add the state, which is unknown."""
        observation, action, reward, mask, ended = compact
        return SequenceBatch(observation, action, reward, mask, reward.new_zeros(*reward.shape, 0), ended)

    def _require(self, split: Split) -> _Table:
        """Return the table of a split; raise a ForbesError if it has no episodes."""
        table = self._tables[split]
        if not table.numbers and not self.hold_out and split != "train":
            raise ForbesError(
                f"{self.path}: hold_out is 0, so the {split} split has no episodes. Set hold_out; a training can do "
                "without: trainer.limit_val_batches 0"
            )
        if not table.numbers:
            raise ForbesError(
                f"{self.path}: the {split} split has no episodes, expected one out of {self.hold_out}. Collect more, "
                "or choose a smaller hold_out"
            )
        return table


def _num_segments(lengths: Tensor, stride: int) -> Tensor:
    """Return the number of segments of each episode, `(E,)` to `(E,)`."""
    return (lengths // stride).clamp(min=1)
