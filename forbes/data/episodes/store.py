"""The episode store: a folder of episodes that only grows, and an index that survives a kill at any instant.

::

    DIR/
      index.jsonl     one JSON object a line, appended and synced: an episode, or what became of some (`EpisodeIndex`)
      000000.npz …    an episode each, written beside, synced and renamed before its line is appended
      set_aside/      episodes of a future that a resumed run has not lived, and whole files the index does not know
      quarantine/     damaged files

Files with other names are left alone. The watermark is the number that the next episode will have: a checkpoint that
holds it says "up to here".
"""

import hashlib
import json
import re
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from forbes.data.episodes.episode import (
    DamagedEpisodeError,
    Episode,
    EpisodeRecord,
    map_episode,
    pack_episode,
    problem_of,
    problem_with,
    read_record,
)
from forbes.data.episodes.index import EpisodeIndex
from forbes.errors import ForbesError
from forbes.files import drop_half_line, locked, remove_halves, replace_file

__all__ = ["EpisodeStore", "EpisodeWriter", "first_held"]

_OPEN_FILES = 256
"""Episodes that are mapped at a time, each with an open file; systems allow 1024 of these."""


class EpisodeStore:
    """The episodes of a folder, as the index says; any number of processes may read while one writes.

    Args:
        path: the folder.

    Raises:
        ForbesError: where a line of the index cannot be read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.index = EpisodeIndex(self.path / "index.jsonl")
        self._verified: set[str] = set()
        self._mapped: dict[tuple[int, str], Episode] = {}

    @property
    def records(self) -> dict[int, EpisodeRecord]:
        """The episodes by number, the oldest first."""
        return self.index.records

    @property
    def watermark(self) -> int:
        """The number that the next episode will have."""
        return self.index.watermark

    def require_folder(self) -> None:
        """Raise a ForbesError where there is none."""
        if not self.path.is_dir():
            raise ForbesError(
                f"{self.path}: no such folder. Name one that has episodes, or collect some: "
                f"forbes data collect --task TASK -o {self.path}"
            )

    def require_episodes(self) -> None:
        """Raise a ForbesError where there are none."""
        self.require_folder()
        if self.records:
            return
        if files := self.files():
            raise ForbesError(
                f"{self.index.path}: lost, but there are the files of {len(files)} episodes. Rebuild it from them: "
                f"forbes data check {self.path}"
            )
        damaged = len([*self.path.glob("quarantine/*.npz")])
        raise ForbesError(
            f"{self.path}: there are no episodes{f' but {damaged} in quarantine' if damaged else ''}. "
            f"Collect some: forbes data collect --task TASK -o {self.path}"
        )

    def refresh(self) -> None:
        """Read the index again: another process may have added to it."""
        self.index.refresh()
        self._close_maps()

    def _close_maps(self) -> None:
        """Let go of the files of episodes that are no longer here, which keep their room on the disk as long."""
        here = {(number, record.sha256) for number, record in self.records.items()}
        self._mapped = {key: episode for key, episode in self._mapped.items() if key in here}

    def file(self, number: int) -> Path:
        """Return the path of an episode."""
        return self.path / f"{number:06d}.npz"

    def files(self) -> list[int]:
        """List the numbers of the episodes whose files are in the folder, in order."""
        names = (path.stem for path in self.path.glob("*.npz"))
        numbers = {int(name) for name in names if re.fullmatch("[0-9]{6,}", name)}
        return sorted(number for number in numbers if self.file(number).is_file())

    def episode(self, number: int) -> Episode:
        """Open an episode; the first time in this process, compare it with its hash.

        Raises:
            DamagedEpisodeError: where the file is not what the index says.
        """
        record = self.records[number]
        key = number, record.sha256
        episode = self._mapped.pop(key, None)
        if episode is None:
            episode = map_episode(self.file(number), record, verify=record.sha256 not in self._verified)
            self._verified.add(record.sha256)
            while len(self._mapped) >= _OPEN_FILES:
                del self._mapped[next(iter(self._mapped))]  # the one whose last use is longest ago
        self._mapped[key] = episode
        return episode


class EpisodeWriter(EpisodeStore):
    """A store that this process, and no other, changes: use it in a `with` statement.

    Entering mends what a kill has left: half a line of the index, half a file, and a whole file without its line. An
    index that is lost, or ends in zeros, is rebuilt from the episodes' files, and stderr says so.

    Raises:
        ForbesError: on entering, where another process writes to the folder.
    """

    def __enter__(self) -> Self:
        self._stack = ExitStack()
        self._stack.enter_context(locked(self.path, "writes episodes here. Choose another folder"))
        lost = self.index.is_lost()
        drop_half_line(self.index.path)
        remove_halves(self.path, "*.npz", self.index.path.name)
        self.refresh()
        if lost:
            self._rebuild()
        self._tidy()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _rebuild(self) -> None:
        """Take the episodes that a lost index does not know from their files, and say so."""
        unknown = [number for number in self.files() if number >= self.watermark]
        found = sum(map(self._restore, unknown))
        if unknown:
            self.index.compact()
            print(
                f"WARNING: {self.index.path}: lost or overwritten with zeros; {found} of {len(unknown)} episodes are "
                "restored from their files, those that cannot be are set aside, and forgotten ones no longer counted",
                file=sys.stderr,
            )

    def _restore(self, number: int) -> bool:
        """Take an episode from its file, unless it is damaged, of another number or of another environment."""
        try:
            record = read_record(self.file(number))
        except ForbesError:
            return False
        fits = record.number == number and not self.index.differs(record)
        if fits:
            self.index.add(record)
        return fits

    def append(self, episode: Episode, seed: int, policy: str, environment: dict[str, Any]) -> EpisodeRecord:
        """Add an episode: when this returns, it survives a power loss; if it raises, the store is as it was.

        Args:
            episode: whole, from its first observation to its last.
            seed: that the environment was reset with.
            policy: that acted.
            environment: what `describe_environment` gives: task, shapes and settings, plain values.

        Raises:
            ForbesError: where the episode is not whole, is of another environment, or cannot be written.
        """
        number = self.watermark
        about: dict[str, Any] = {
            "number": number,
            "steps": len(episode.reward) - 1,
            "frames": episode.frames,
            "total_reward": episode.total_reward,
            "terminated": episode.terminated,
            "seed": seed,
            "policy": policy,
            "environment": json.loads(json.dumps(environment)),
        }
        if problem := problem_of(episode) or problem_with(about["environment"], episode):
            raise ForbesError(f"{self.file(number)}: not stored, {problem}. Mend the environment or the policy")
        content = pack_episode(episode, about)
        record = EpisodeRecord(**about, size=len(content), sha256=hashlib.sha256(content).hexdigest())
        if name := self.index.differs(record):
            there = next(iter(self.records.values())).settings.get(name)
            raise ForbesError(
                f"{self.path}: holds episodes whose {name} is {there}, not {record.settings.get(name)}. "
                "Choose another folder"
            )
        try:
            replace_file(self.file(number), content)
            self.index.append(record._asdict())
        except ForbesError:
            self.file(number).unlink(missing_ok=True)
            raise
        return record

    def set_aside(self, watermark: int) -> int:
        """Go back to a checkpoint: move the episodes from this number on out of the way, and count them.

        Raises:
            ForbesError: where the store has never been so far.
        """
        if watermark > self.watermark:
            raise ForbesError(
                f"{self.path}: has {self.watermark} episodes, expected the {watermark} of the checkpoint. "
                "Name the folder of that run"
            )
        later = sum(number >= watermark for number in self.records)
        if watermark < self.watermark:
            self.index.append({"set_aside_from": watermark})
            self._tidy()
            self.index.compact()
        return later

    def forget(self, before: int) -> None:
        """Delete the episodes before this number; one that a checkpoint may still draw must not be among them."""
        if before > self.index.first:
            self.index.append({"forgotten_before": before})
            self._tidy()
            self.index.compact_if_long()

    def quarantine(self, number: int) -> None:
        """Take a damaged episode out of the store, and keep its file, if there is one, for the curious."""
        self.index.append({"quarantined": number})
        if self.file(number).exists():
            _move(self.file(number), self.path / "quarantine")

    def damage(self) -> dict[int, str]:
        """Read every file anew, and say of each damaged one what is wrong."""
        found = {}
        for number, record in self.records.items():
            try:
                map_episode(self.file(number), record, verify=True)
            except DamagedEpisodeError as error:
                found[number] = error.reason
        return found

    def _tidy(self) -> None:
        """Put the files that the index does not know aside, and delete the forgotten ones."""
        self._close_maps()
        for number in self.files():
            if number < self.index.first:
                self.file(number).unlink()
            elif number not in self.records:
                _move(self.file(number), self.path / "set_aside")


def first_held(records: Iterable[EpisodeRecord], capacity: int | None) -> int:
    """Return the number of the oldest episode that a replay of so many agent steps holds; the latest is always held."""
    first, steps = 0, 0
    for record in reversed(list(records)):
        steps += record.steps
        if capacity is not None and first and steps > capacity:
            return first
        first = record.number
    return first


def _move(path: Path, folder: Path) -> None:
    """Move a file to a folder, under a name that is free there."""
    folder.mkdir(exist_ok=True)
    target, copy = folder / path.name, 1
    while target.exists():
        copy += 1
        target = folder / f"{path.stem}-{copy}{path.suffix}"
    path.rename(target)
