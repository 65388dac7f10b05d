"""The episode store: a folder of episodes that only grows, and an index that survives a kill at any instant.

::

    DIR/
      index.jsonl     one JSON object a line, appended and synced: an episode, or what became of some
      000000.npz …    an episode each, written beside, synced and renamed before its line is appended
      set_aside/      episodes of a future that a resumed run has not lived, and whole files the index does not know
      quarantine/     damaged files

A line is an `EpisodeRecord`, or one of ``{"set_aside_from": n}``, ``{"forgotten_before": n}``, ``{"quarantined": n}``.
The watermark is the number that the next episode will have: a checkpoint that holds it says "up to here".
"""

import errno
import hashlib
import json
import os
from collections.abc import Iterable
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

from forbes.data.episodes import (
    DamagedEpisodeError,
    Episode,
    EpisodeRecord,
    map_episode,
    pack_episode,
    problem_of,
    problem_with,
)
from forbes.errors import ForbesError
from forbes.files import fsync_folder, locked, no_link, replace_file

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
        self.index = self.path / "index.jsonl"
        self._verified: set[str] = set()
        self._open = lru_cache(maxsize=_OPEN_FILES)(self._map)
        self.refresh()

    def require_episodes(self) -> None:
        """Raise a ForbesError where there are none."""
        if not self.path.is_dir():
            raise ForbesError(
                f"{self.path}: no such folder. Name one that has episodes, or collect some: "
                f"forbes data collect --task TASK -o {self.path}"
            )
        if not self.records:
            damaged = len([*self.path.glob("quarantine/*.npz")])
            raise ForbesError(
                f"{self.path}: there are no episodes{f' but {damaged} in quarantine' if damaged else ''}. "
                f"Collect some: forbes data collect --task TASK -o {self.path}"
            )

    def refresh(self) -> None:
        """Read the index again: another process may have added to it."""
        self.records: dict[int, EpisodeRecord] = {}
        """By number, the oldest first."""
        self.watermark = 0
        self.first = 0
        """Episodes before this number are forgotten."""
        self.forgotten_steps, self.forgotten_frames = 0, 0
        text = self.index.read_text(errors="replace") if self.index.is_file() else ""
        for place, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):  # a kill may cut the last
            try:
                self._apply(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
                raise ForbesError(
                    f"{self.index}: line {place} is not a line of the index. Delete it; the episode's file stays"
                ) from error

    def _apply(self, line: dict[str, Any]) -> None:
        """Follow one line of the index."""
        if "number" in line:
            record = EpisodeRecord(**line)
            record.require_types()
            self.records[record.number] = record
            self.watermark = record.number + 1
            return
        ((event, number),) = line.items()
        if type(number) is not int:
            raise TypeError(number)
        if event == "quarantined":
            self.records.pop(number, None)
        elif event == "set_aside_from":
            self.watermark = number
            self.records = {n: record for n, record in self.records.items() if n < number}
        elif event == "forgotten_before":
            self.first = number
            for forgotten in [n for n in self.records if n < number]:
                record = self.records.pop(forgotten)
                self.forgotten_steps += record.steps
                self.forgotten_frames += record.frames
        else:
            raise ValueError(event)

    def file(self, number: int) -> Path:
        """Give the path of an episode."""
        return self.path / f"{number:06d}.npz"

    def episode(self, number: int) -> Episode:
        """Open an episode; the first time in this process, compare it with its hash.

        Raises:
            DamagedEpisodeError: where the file is not what the index says.
        """
        return self._open(number, self.records[number].sha256)

    def _map(self, number: int, sha256: str) -> Episode:
        episode = map_episode(self.file(number), self.records[number], verify=sha256 not in self._verified)
        self._verified.add(sha256)
        return episode


class EpisodeWriter(EpisodeStore):
    """A store that this process, and no other, changes: use it in a `with` statement.

    Entering mends what a kill has left: half a line of the index, half a file, and a whole file without its line.

    Raises:
        ForbesError: on entering, where another process writes to the folder.
    """

    def __enter__(self) -> Self:
        self._stack = ExitStack()
        self._stack.enter_context(locked(self.path, "writes episodes here. Choose another folder"))
        if self.index.is_file():
            with open(self.index, "rb+", opener=no_link) as file:
                file.truncate(file.read().rfind(b"\n") + 1)
        for half in self.path.glob(".*.npz.*"):
            half.unlink()
        self.refresh()
        self._tidy()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

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
        self._require_same_environment(record)
        try:
            replace_file(self.file(number), content)
            self._log(record._asdict())
        except OSError as error:
            self.file(number).unlink(missing_ok=True)
            raise ForbesError(
                f"{self.file(number)}: the episode cannot be written ({error.strerror}), those before it are "
                "untouched. Make room, or choose another folder"
            ) from error
        self._apply(record._asdict())
        return record

    def _require_same_environment(self, record: EpisodeRecord) -> None:
        ours = next(iter(self.records.values()), record).settings
        for name in ours | record.settings:
            if (there := ours.get(name)) != (here := record.settings.get(name)):
                raise ForbesError(
                    f"{self.path}: holds episodes whose {name} is {there}, not {here}. Choose another folder"
                )

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
            self._log({"set_aside_from": watermark})
            self.refresh()
            self._tidy()
        return later

    def forget(self, before: int) -> None:
        """Delete the episodes before this number; one that a checkpoint may still draw must not be among them."""
        if before > self.first:
            self._log({"forgotten_before": before})
            self.refresh()
            self._tidy()

    def quarantine(self, number: int) -> None:
        """Take a damaged episode out of the store, and keep its file, if there is one, for the curious."""
        self._log({"quarantined": number})
        self.records.pop(number)
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

    def _log(self, line: dict[str, Any]) -> None:
        """Append a line to the index, whole or not at all."""
        content = json.dumps(line).encode() + b"\n"
        with open(self.index, "ab", buffering=0, opener=no_link) as file:
            size = file.tell()
            try:
                if file.write(content) < len(content):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file.fileno())
            except OSError:
                file.truncate(size)
                raise
        if size == 0:
            fsync_folder(self.path)

    def _tidy(self) -> None:
        """Put the files that the index does not know aside, and delete the forgotten ones."""
        for path in self.path.glob("[0-9]*.npz"):
            if int(path.stem) < self.first:
                path.unlink()
            elif int(path.stem) not in self.records:
                _move(path, self.path / "set_aside")


def first_held(records: Iterable[EpisodeRecord], capacity: int | None) -> int:
    """Give the number of the oldest episode that a replay of so many agent steps holds; the latest is always held."""
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
