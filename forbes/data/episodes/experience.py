"""Experience of a learning agent: an environment, a store of its episodes, and segments sampled from the store."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from forbes.choices import LONGEST
from forbes.data.episodes.collection import MakePolicy, describe_environment, episode_seed, play_whole
from forbes.data.episodes.episode import Episode, EpisodeRecord
from forbes.data.episodes.index import first_held
from forbes.data.episodes.replay import Replay, Segments
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.data.episodes.worker import EpisodeWorker
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.distributed import gathered, num_ranks, rank
from forbes.envs import TIME_LIMIT, EnvironmentProcess, find_environment
from forbes.errors import ForbesError, require_at_least
from forbes.factors import Discrete, as_discrete
from forbes.shapes import Shape, shape_of

__all__ = ["Experience"]


class Experience(SequenceSource):
    """A `Replay` that is empty at first and grows by `collect`.

    All episodes belong to the training split. A checkpoint stores the number of episodes. A run that resumes from it
    moves later episodes away and replays them.

    Args:
        task: task as for `forbes data collect`: `cartpole_swingup`, `mountain_hike`, `gymnasium:ID`, or your own class.
        options: options of the environment, e.g. `{pixels: false, action_repeat: 4}`.
        capacity: maximal number of agent steps to keep, in the latest episodes; None keeps all.
        timeout: seconds within which the environment must answer before it is restarted.
        time_limit: number of steps after which an episode is truncated.

    Raises:
        ForbesError: for an unknown task or option, a timeout that is not above 0, or a capacity or time_limit
            below 1.

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
        if capacity is not None:
            require_at_least(1, "Experience", capacity=capacity)
        if time_limit < 1:
            raise ForbesError(f"Experience: time_limit is {time_limit}, expected at least 1 step. Choose another")
        self.task, self.options, self.capacity = task, options or {}, capacity
        self.timeout, self.time_limit = timeout, time_limit
        self._make = find_environment(task, **self.options)
        self._writer: EpisodeWriter | None = None
        self._replay: Replay | None = None
        self.followed: Path | None = None  # the folder to which another process of the training writes
        self._shapes: dict[str, Any] | None = None

    @cached_property
    def environment(self) -> EnvironmentProcess:
        """The environment, in a process that starts on first use."""
        return EnvironmentProcess(self._make, self.timeout, self.time_limit)

    @cached_property
    def player(self) -> EpisodeWorker:
        """Worker that plays episodes while this process trains. It starts on first use."""
        return EpisodeWorker(self._make, self.timeout, self.time_limit)

    @property
    def observation_shape(self) -> Shape:  # type: ignore[override]
        """Shape of one observation, without batch and time."""
        return shape_of(self._known_shapes()["observation_shape"])

    @property
    def action_dim(self) -> int:  # type: ignore[override]
        """Dimension of an action, A."""
        return int(self._known_shapes()["action_dim"])

    @property
    def discrete(self) -> Discrete:  # type: ignore[override]
        """Kind of actions, see `Environment.discrete`."""
        return as_discrete(self._known_shapes()["discrete"])

    def recall(self, folder: Path) -> None:
        """Read the shapes from stored episodes, if there are any, so that no environment has to be started."""
        newest = max(EpisodeStore(folder).records.values(), default=None)
        self._shapes = newest and newest.environment

    def _known_shapes(self) -> dict[str, Any]:
        """Return the description of the environment, which is started only if there are no stored episodes."""
        if self._shapes is None:
            self._shapes = describe_environment(self.environment)
        return self._shapes

    def open(self, folder: Path) -> None:
        """Open a folder for the episodes, and lock it until `close`."""
        self._writer = EpisodeWriter(folder).__enter__()
        self._refresh()

    def follow(self) -> None:
        """Sample from the episodes that another process of the training has stored in `followed` by now."""
        if self._replay is None:
            self._replay = Replay(str(self.followed), self.capacity, hold_out=0)
        else:
            self._replay.refresh()

    def close(self) -> None:
        """Unlock the folder and close the environment. Episodes and shapes remain accessible."""
        if self._writer is not None:
            self._writer.__exit__()
        for name in ("environment", "player"):
            if name in self.__dict__:
                self.__dict__.pop(name).close()

    def collect(
        self, numbers: range, make_policy: MakePolicy, policy: str, seed: int, per_rank: bool = False
    ) -> Iterator[EpisodeRecord]:
        """Play and store the next episodes. Episode n depends only on (seed, n) and the policy.

        Args:
            numbers: numbers of the episodes; the first is the watermark.
            make_policy: function that makes the policy of an episode.
            policy: name of the policy, for the record.
            seed: random seed for episodes and policies.
            per_rank: whether all ranks call this with the same policy, and each plays every R-th episode. The first one
                stores all in their order.

        Yields:
            Record of each episode, once it is safely stored; nothing in the other ranks.
        """
        ranks, first = (num_ranks(), rank()) if per_rank else (1, 0)
        for start in range(numbers.start, numbers.stop, ranks):
            number, episode = start + first, None
            if number in numbers:
                episode = play_whole(self.environment, make_policy, episode_seed(seed, number), number)
            for played in gathered(episode) if per_rank else [episode]:
                if played is not None:
                    yield self._store(played, policy, seed)

    def begin(self, make_policy: MakePolicy, seed: int) -> None:
        """Start the next episode in the background; `finish` stores it.

        Args:
            make_policy: function that makes the policy of the episode; must be picklable.
            seed: random seed, as for `collect`.
        """
        number = self._require_writer().watermark
        self.player.begin(make_policy, number, episode_seed(seed, number))

    def finish(self, policy: str, seed: int) -> EpisodeRecord:
        """Wait for the episode started by `begin`, and store it. The arguments are those of `collect`."""
        return self._store(self.player.finish(), policy, seed)

    def _store(self, episode: Episode, policy: str, seed: int) -> EpisodeRecord:
        """Store the next episode, and sample from it, too."""
        writer = self._require_writer()
        seed_of_episode = episode_seed(seed, writer.watermark)
        record = writer.append(episode, seed_of_episode, policy, describe_environment(self.environment))
        self._refresh()
        return record

    def forget(self, newest: int = 1) -> None:
        """Delete episodes beyond `capacity`. Call only after a checkpoint has recorded the newest ones.

        Episodes that the previous checkpoint may still sample, without the `newest` ones, are kept.
        """
        writer = self._require_writer()
        writer.forget(first_held([*writer.records.values()][:-newest], self.capacity))
        self._refresh()

    def growth(self, episodes: int) -> float:
        """Estimate the number of bytes by which the store grows with `episodes` more, from the existing ones."""
        records = self._require_writer().records.values()
        steps = sum(record.steps for record in records)
        more = episodes * steps / len(records)
        if self.capacity is not None:
            more = min(more, max(0, self.capacity - steps))
        return more * sum(record.size for record in records) / steps

    def begun(self, policy: str, seed: int, most: int) -> int:
        """Return how many of the first `most` stored episodes `collect` would reproduce exactly.

        These are the leading episodes with the same policy, seed and number.
        """
        count = 0
        for record in self._require_writer().records.values():
            same = record.policy == policy and record.seed == episode_seed(seed, count) and record.number == count
            if not same or count == most:
                break
            count += 1
        return count

    def newest(self, count: int = 1) -> list[EpisodeRecord]:
        """Return the records of the latest stored episodes, the newest last."""
        return list(self._require_writer().records.values())[-count:]

    @property
    def env_steps(self) -> int:
        """Number of simulator frames so far, including action repeat."""
        writer = self._require_writer()
        return writer.index.forgotten_frames + sum(record.frames for record in writer.records.values())

    @property
    def agent_steps(self) -> int:
        """Number of actions so far."""
        writer = self._require_writer()
        return writer.index.forgotten_steps + sum(record.steps for record in writer.records.values())

    @property
    def watermark(self) -> int | None:
        """Number of episodes so far. Setting a smaller number moves the later ones to `set_aside/`."""
        return None if self._writer is None else self._writer.watermark

    @watermark.setter
    def watermark(self, value: int | None) -> None:
        if value is not None and self.followed is None:
            self._require_writer().set_aside(value)
            self._refresh()

    def sha256(self) -> str:
        """Hash the stored episodes."""
        return self._replay.sha256() if self._replay else ""

    def size(self, split: Split) -> int:
        """Return the number of segments of a split; 0 for held-out splits."""
        return self._replay.size(split) if self._replay else 0

    def train_index(self, batch_size: int, length: int, seed: int, update: int) -> Tensor:
        """Sample the segments of one training batch, int64 `(B,)`, as `Replay.train_index` does."""
        return self._require_replay().train_index(batch_size, length, seed, update)

    def latest(self, count: int) -> Tensor:
        """Return the first segments of the newest episodes, the newest first, int64 `(count,)` or fewer."""
        return self._require_replay().latest(count)

    def gather(self, split: Split, index: Tensor, length: int) -> Segments:
        """Return segments by index, int64 (B,), read from their files."""
        return self._require_replay().gather(split, index, length)

    def decode(self, compact: Segments) -> SequenceBatch:
        """Add the state, which is unknown."""
        return self._require_replay().decode(compact)

    def _refresh(self) -> None:
        """Sample from the episodes that are stored now."""
        writer = self._require_writer()
        if not writer.records:
            self._replay = None
        elif self._replay is None:
            self._replay = Replay(str(writer.path), self.capacity, hold_out=0)
        else:
            self._replay.refresh()

    def _require_writer(self) -> EpisodeWriter:
        if self._writer is None:
            raise ForbesError(f"Experience: the episodes of {self.task} are not open, expected a running `forbes fit`")
        return self._writer

    def _require_replay(self) -> Replay:
        if self._replay is None:
            raise ForbesError(f"Experience: there are no episodes of {self.task} yet. Add the callback Collect")
        return self._replay
