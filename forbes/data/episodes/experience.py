"""Episodes that an agent plays while it learns: an environment, the store they go to, and the windows drawn from it."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from forbes.choices import LONGEST
from forbes.data.episodes.collection import MakePolicy, collect_episodes, describe_environment, episode_seed
from forbes.data.episodes.episode import EpisodeRecord
from forbes.data.episodes.replay import Replay, Segments
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter, first_held
from forbes.data.episodes.worker import EpisodeWorker
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.envs import TIME_LIMIT, EnvironmentProcess, find_environment
from forbes.errors import ForbesError

__all__ = ["Experience"]


class Experience(SequenceSource):
    """What an agent has lived through so far: a `Replay` that begins empty and grows by `collect`.

    All episodes are of the training split. A checkpoint keeps the watermark; a run that goes on from it puts later
    episodes aside, and plays them anew.

    Args:
        task: as for `forbes data collect`: `cartpole_swingup`, `mountain_hike`, `gymnasium:ID`, a class of your own.
        options: of its environment, e.g. `{pixels: false, action_repeat: 4}`.
        capacity: agent steps of the latest episodes that are kept; None keeps all.
        timeout: seconds in which the environment must answer; one that does not is started anew.
        time_limit: steps after which an episode that has not ended by itself is truncated.

    Raises:
        ForbesError: for an unknown task or option, a timeout that is not above 0, or a time_limit below 1.

    Example:
        >>> source = forbes.Experience("gymnasium:CartPole-v1", options={"action_repeat": 2})
        >>> source.observation_shape, source.action_dim, source.discrete
        ((4,), 2, True)
        >>> source.close()
    """

    def __init__(
        self,
        task: str,
        options: dict[str, Any] | None = None,
        capacity: int | None = None,
        timeout: float = 60.0,
        time_limit: int = TIME_LIMIT,
    ) -> None:
        if not 0 < timeout <= LONGEST:
            raise ForbesError(
                f"Experience: timeout is {timeout}, expected seconds above 0, at most {LONGEST}. Choose another"
            )
        if time_limit < 1:
            raise ForbesError(f"Experience: time_limit is {time_limit}, expected at least 1 step. Choose another")
        self.task, self.options, self.capacity = task, options or {}, capacity
        self.timeout, self.time_limit = timeout, time_limit
        self._make = find_environment(task, **self.options)
        self._writer: EpisodeWriter | None = None
        self._replay: Replay | None = None
        self._shapes: dict[str, Any] | None = None

    @cached_property
    def environment(self) -> EnvironmentProcess:
        """The environment, in a process that starts when it is first asked for."""
        return EnvironmentProcess(self._make, self.timeout, self.time_limit)

    @cached_property
    def player(self) -> EpisodeWorker:
        """What plays while this process trains; it starts when it is first asked for."""
        return EpisodeWorker(self._make, self.timeout, self.time_limit)

    @property
    def observation_shape(self) -> tuple[int, ...]:  # type: ignore[override]
        """See `SequenceSource`."""
        return tuple(self._known_shapes()["observation_shape"])

    @property
    def action_dim(self) -> int:  # type: ignore[override]
        """See `SequenceSource`."""
        return int(self._known_shapes()["action_dim"])

    @property
    def discrete(self) -> bool:  # type: ignore[override]
        """See `SequenceSource`."""
        return bool(self._known_shapes()["discrete"])

    def recall(self, folder: Path) -> None:
        """Take the shapes from the episodes of a store, where it has some: then no environment starts to tell them."""
        newest = max(EpisodeStore(folder).records.values(), default=None)
        self._shapes = newest and newest.environment

    def _known_shapes(self) -> dict[str, Any]:
        """Return the shapes, from the environment unless they are known, as a store records them."""
        if self._shapes is None:
            self._shapes = describe_environment(self.environment)
        return self._shapes

    def open(self, folder: Path) -> None:
        """Keep the episodes in a folder, which no other process may write to until `close`."""
        self._writer = EpisodeWriter(folder).__enter__()
        self._look()

    def close(self) -> None:
        """Leave the folder and end the environment; what is known of the episodes stays known."""
        if self._writer is not None:
            self._writer.__exit__()
        for name in ("environment", "player"):
            if name in self.__dict__:
                self.__dict__.pop(name).close()

    def collect(self, until: int, make_policy: MakePolicy, policy: str, seed: int) -> Iterator[EpisodeRecord]:
        """Play until there have been so many episodes; episode n depends on (seed, n) and the policy only.

        Args:
            until: episodes, those there are included.
            make_policy: makes the policy of an episode.
            policy: its name, for the record.
            seed: of episodes and policies.
        """
        for record in collect_episodes(self.environment, self._open(), make_policy, policy, until, seed):
            self._look()
            yield record

    def begin(self, make_policy: MakePolicy, seed: int) -> None:
        """Let the next episode be played while this process does something else; `finish` stores it.

        Args:
            make_policy: as for `collect`; can be pickled.
            seed: as for `collect`.
        """
        number = self._open().watermark
        self.player.begin(make_policy, number, episode_seed(seed, number))

    def finish(self, policy: str, seed: int) -> EpisodeRecord:
        """Wait for the episode that was begun, and store it; arguments as for `collect`."""
        writer, episode = self._open(), self.player.finish()
        chance = episode_seed(seed, writer.watermark)
        record = writer.append(episode, chance, policy, describe_environment(self.environment))
        self._look()
        return record

    def forget(self) -> None:
        """Delete the episodes beyond the capacity, which are drawn no more; a checkpoint must know of the newest.

        The checkpoint before it, which lacks the newest, may still be read: what it draws from stays.
        """
        writer = self._open()
        writer.forget(first_held([*writer.records.values()][:-1], self.capacity))
        self._look()

    def growth(self, episodes: int) -> float:
        """Estimate the bytes by which so many further episodes make the store grow, from those that are there."""
        records = self._open().records.values()
        steps = sum(record.steps for record in records)
        more = episodes * steps / len(records)
        if self.capacity is not None:
            more = min(more, max(0, self.capacity - steps))
        return more * sum(record.size for record in records) / steps

    def begun(self, policy: str, seed: int, most: int) -> int:
        """Count the first episodes, of at most so many, that `collect` with these arguments would play again."""
        count = 0
        for record in self._open().records.values():
            same = record.policy == policy and record.seed == episode_seed(seed, count) and record.number == count
            if not same or count == most:
                break
            count += 1
        return count

    @property
    def newest(self) -> EpisodeRecord:
        """The record of the latest episode that is there."""
        return list(self._open().records.values())[-1]

    @property
    def env_steps(self) -> int:
        """Frames of the simulator so far, action repeat included."""
        writer = self._open()
        return writer.index.forgotten_frames + sum(record.frames for record in writer.records.values())

    @property
    def agent_steps(self) -> int:
        """Actions so far."""
        writer = self._open()
        return writer.index.forgotten_steps + sum(record.steps for record in writer.records.values())

    @property
    def watermark(self) -> int | None:
        """How many episodes there have been; to set it to fewer puts the later ones aside."""
        return None if self._writer is None else self._writer.watermark

    @watermark.setter
    def watermark(self, value: int | None) -> None:
        if value is not None:
            self._open().set_aside(value)
            self._look()

    def sha256(self) -> str:
        """Hash the episodes that there are."""
        return self._replay.sha256() if self._replay else ""

    def size(self, split: Split) -> int:
        """Count the windows of a split; held-out ones are none."""
        return self._replay.size(split) if self._replay else 0

    def train_index(self, batch_size: int, length: int, seed: int, update: int) -> Tensor:
        """See `Replay.train_index`."""
        return self._drawn().train_index(batch_size, length, seed, update)

    def latest(self, count: int) -> Tensor:
        """See `Replay.latest`."""
        return self._drawn().latest(count)

    def gather(self, split: Split, index: Tensor, length: int) -> Segments:
        """See `Replay.gather`."""
        return self._drawn().gather(split, index, length)

    def decode(self, compact: Segments) -> SequenceBatch:
        """See `Replay.decode`."""
        return self._drawn().decode(compact)

    def _look(self) -> None:
        """Draw from what is there now."""
        writer = self._open()
        if not writer.records:
            self._replay = None
        elif self._replay is None:
            self._replay = Replay(str(writer.path), self.capacity, hold_out=0)
        else:
            self._replay.refresh()

    def _open(self) -> EpisodeWriter:
        if self._writer is None:
            raise ForbesError(f"Experience: the episodes of {self.task} are not open, expected a running `forbes fit`")
        return self._writer

    def _drawn(self) -> Replay:
        if self._replay is None:
            raise ForbesError(f"Experience: there are no episodes of {self.task} yet. Add the callback Collect")
        return self._replay
