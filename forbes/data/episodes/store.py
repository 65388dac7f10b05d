"""The episode store: a folder of episodes, and an index that survives a kill at any time.

::

    DIR/
      index.jsonl     one JSON object per line, appended and synced: an episode, or an event (`EpisodeIndex`)
      000000.npz …    one episode each, written to a temporary file, synced and renamed before its line is appended
      set_aside/      episodes later than the checkpoint of a resumed run, and intact files that the index does not list
      quarantine/     damaged files

Other files are left alone. The watermark is the number of the next episode. A checkpoint stores it to record which
episodes exist.
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
"""Maximal number of mapped episodes, each with an open file. Systems typically allow 1024 open files."""


class EpisodeStore:
    """The episodes in the index of a folder. Any number of processes may read while one writes.

    Args:
        path: folder of the store.

    Raises:
        ForbesError: if a line of the index cannot be read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.index = EpisodeIndex(self.path / "index.jsonl")
        self._verified: set[str] = set()
        self._mapped: dict[tuple[int, str], Episode] = {}

    @property
    def records(self) -> dict[int, EpisodeRecord]:
        """Records of the episodes by number, the oldest first."""
        return self.index.records

    @property
    def watermark(self) -> int:
        """Number of the next episode."""
        return self.index.watermark

    def require_folder(self) -> None:
        """Raise a ForbesError if the folder does not exist."""
        if not self.path.is_dir():
            raise ForbesError(
                f"{self.path}: no such folder. Name one that has episodes, or collect some: "
                f"forbes data collect --task TASK -o {self.path}"
            )

    def require_episodes(self) -> None:
        """Raise a ForbesError if there are no episodes."""
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
        """Read the index again, since another process may have extended it."""
        self.index.refresh()
        self._close_maps()

    def _close_maps(self) -> None:
        """Unmap episodes that are no longer in the index, so that their disk space is freed."""
        listed = {(number, record.sha256) for number, record in self.records.items()}
        self._mapped = {key: episode for key, episode in self._mapped.items() if key in listed}

    def file(self, number: int) -> Path:
        """Return the path of an episode's file."""
        return self.path / f"{number:06d}.npz"

    def files(self) -> list[int]:
        """Return the sorted numbers of the episodes whose files are in the folder."""
        names = (path.stem for path in self.path.glob("*.npz"))
        numbers = {int(name) for name in names if re.fullmatch("[0-9]{6,}", name)}
        return sorted(number for number in numbers if self.file(number).is_file())

    def episode(self, number: int) -> Episode:
        """Memory-map an episode. Its hash is verified on the first access of this process.

        Raises:
            DamagedEpisodeError: if the file does not match the index.
        """
        record = self.records[number]
        key = number, record.sha256
        episode = self._mapped.pop(key, None)
        if episode is None:
            episode = map_episode(self.file(number), record, verify=record.sha256 not in self._verified)
            self._verified.add(record.sha256)
            while len(self._mapped) >= _OPEN_FILES:
                del self._mapped[next(iter(self._mapped))]  # the least recently used
        self._mapped[key] = episode
        return episode


class EpisodeWriter(EpisodeStore):
    """A store that is locked for this process. Use it in a `with` statement.

    Entering repairs the traces of a kill: a truncated line of the index, a partial file, and a complete file without
    its line. An index that is lost, or ends in zeros, is rebuilt from the files, with a warning on stderr.

    Raises:
        ForbesError: on entering, if another process writes to the folder.
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
        """Add the episodes that a lost index does not list from their files, and print a warning."""
        unlisted = [number for number in self.files() if number >= self.watermark]
        restored = sum(map(self._restore, unlisted))
        if unlisted:
            self.index.compact()
            print(
                f"WARNING: {self.index.path}: lost or overwritten with zeros; {restored} of {len(unlisted)} episodes "
                "are restored from their files, the others are moved to set_aside/, and deleted ones are no longer "
                "counted",
                file=sys.stderr,
            )

    def _restore(self, number: int) -> bool:
        """Add an episode from its file, unless it is damaged or has another number or environment."""
        try:
            record = read_record(self.file(number))
        except ForbesError:
            return False
        fits = record.number == number and not self.index.differs(record)
        if fits:
            self.index.add(record)
        return fits

    def append(self, episode: Episode, seed: int, policy: str, environment: dict[str, Any]) -> EpisodeRecord:
        """Add an episode. After the return it survives a power loss; on an error the store is unchanged.

        Args:
            episode: complete episode, from its first to its last observation.
            seed: seed with which the environment was reset.
            policy: name of the policy.
            environment: description from `describe_environment`: task, shapes and settings, as plain values.

        Raises:
            ForbesError: if the episode is invalid, is from another environment, or cannot be written.
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
            raise ForbesError(f"{self.file(number)}: not stored, {problem}. Fix the environment or the policy")
        content = pack_episode(episode, about)
        record = EpisodeRecord(**about, size=len(content), sha256=hashlib.sha256(content).hexdigest())
        if name := self.index.differs(record):
            stored = next(iter(self.records.values())).settings.get(name)
            raise ForbesError(
                f"{self.path}: has episodes whose {name} is {stored}, not {record.settings.get(name)}. "
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
        """Go back to a checkpoint: move the episodes from this number on to `set_aside/`, and return their number.

        Raises:
            ForbesError: if the store has had fewer episodes.
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
        """Delete the episodes before this number. No checkpoint in use may still sample from them."""
        if before > self.index.first:
            self.index.append({"forgotten_before": before})
            self._tidy()
            self.index.compact_if_long()

    def quarantine(self, number: int) -> None:
        """Remove a damaged episode from the index, and move its file, if there is one, to `quarantine/`."""
        self.index.append({"quarantined": number})
        if self.file(number).exists():
            _move(self.file(number), self.path / "quarantine")

    def damage(self) -> dict[int, str]:
        """Verify every file, and return the damaged episodes with the reason."""
        found = {}
        for number, record in self.records.items():
            try:
                map_episode(self.file(number), record, verify=True)
            except DamagedEpisodeError as error:
                found[number] = error.reason
        return found

    def _tidy(self) -> None:
        """Move files that the index does not list to `set_aside/`, and delete those it has forgotten."""
        self._close_maps()
        for number in self.files():
            if number < self.index.first:
                self.file(number).unlink()
            elif number not in self.records:
                _move(self.file(number), self.path / "set_aside")


def first_held(records: Iterable[EpisodeRecord], capacity: int | None) -> int:
    """Return the number of the oldest episode within `capacity` agent steps. The latest one is always included."""
    first, steps = 0, 0
    for record in reversed(list(records)):
        steps += record.steps
        if capacity is not None and first and steps > capacity:
            return first
        first = record.number
    return first


def _move(path: Path, folder: Path) -> None:
    """Move a file to a folder, with a suffix if its name exists there."""
    folder.mkdir(exist_ok=True)
    target, copy = folder / path.name, 1
    while target.exists():
        copy += 1
        target = folder / f"{path.stem}-{copy}{path.suffix}"
    path.rename(target)
