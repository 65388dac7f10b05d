"""The episode store: a folder of episodes, and an index that survives a kill at any time.

::

    DIR/
      index.jsonl     one JSON object per line, appended and synced: an episode, or an event (`EpisodeIndex`)
      000000.npz …    one episode each, written to a temporary file, synced and renamed before its line is appended
      verified.jsonl  which files were compared with their hashes, and when (`VerifiedFiles`); may be deleted
      set_aside/      episodes later than the checkpoint of a resumed run, and intact files that the index does not list
      quarantine/     damaged files

Other files are left alone. The watermark is the number of the next episode. A checkpoint stores it to record which
episodes exist.
"""

import hashlib
import re
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from forbes.data.episodes.episode import (
    DamagedEpisodeError,
    Episode,
    EpisodeFile,
    EpisodeRecord,
    describe_episode,
    locate_episode,
    map_episode,
    pack_episode,
    problem_of,
    problem_with,
    read_record,
    stamp_of,
)
from forbes.data.episodes.index import EpisodeIndex
from forbes.data.episodes.verified import VerifiedFiles
from forbes.errors import ForbesError
from forbes.files import drop_half_line, locked, remove_halves, replace_file

__all__ = ["EpisodeStore", "EpisodeWriter"]

_SHOWN = 2**30
"""Bytes to verify from which on a progress bar is shown, since they take a second."""


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
        self._verified = VerifiedFiles(self.path / "verified.jsonl")
        self._files: dict[tuple[int, str], EpisodeFile] = {}

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

    def file(self, number: int) -> Path:
        """Return the path of an episode's file."""
        return self.path / f"{number:06d}.npz"

    def files(self) -> list[int]:
        """Return the sorted numbers of the episodes whose files are in the folder."""
        names = (path.stem for path in self.path.glob("*.npz"))
        numbers = {int(name) for name in names if re.fullmatch("[0-9]{6,}", name)}
        return sorted(number for number in numbers if self.file(number).is_file())

    def episode(self, number: int) -> Episode:
        """Memory-map an episode.

        Raises:
            DamagedEpisodeError: if the file does not match the index.
        """
        record = self.records[number]
        return map_episode(self.file(number), record, self._verified.stamp(record.sha256))

    def verify(self, numbers: Iterable[int]) -> None:
        """Compare files with their hashes, unless they have not changed since they were last compared.

        Raises:
            DamagedEpisodeError: for the first file that does not match the index.
        """
        new = {number: self.records[number] for number in numbers if self._key(number) not in self._files}
        unverified = [record for record in new.values() if self._verified.stamp(record.sha256) is None]
        short = sum(record.size for record in unverified) < _SHOWN
        console, total = Console(stderr=True), len(new)
        with ThreadPoolExecutor() as pool:  # hashing and reading let other threads run
            files = track(
                pool.map(self._locate, new),
                f"verifying {self.path}",
                total,
                disable=short,
                console=console,
                transient=True,
            )
            located = dict(zip(new, files, strict=True))
        self._files |= {self._key(number): file for number, file in located.items()}
        self._verified.add({new[number].sha256: file.stamp for number, file in located.items()})

    def read(self, number: int, start: int, into: Sequence[NDArray[Any]]) -> None:
        """Read steps of an episode. Its file is verified again if it has changed.

        Args:
            number: number of the episode.
            start: the first step.
            into: contiguous arrays for observation (its parts by name), action and reward, as long as the steps.

        Raises:
            DamagedEpisodeError: if the file does not match the index.
            ForbesError: if another process has removed it.
        """
        path, key = self.file(number), self._key(number)
        try:
            with open(path, "rb", buffering=0) as file:
                if key not in self._files or self._files[key].stamp != stamp_of(file):
                    self._files[key] = self._locate(number)
                whole = self._files[key].read(file, start, into)
        except (FileNotFoundError, DamagedEpisodeError) as error:
            if not path.exists() and number not in EpisodeIndex(self.path / "index.jsonl").records:
                removed = f"{path}: the process that writes episodes here has removed it since"
                raise ForbesError(f"{removed}. Read a copy of the folder, or set a smaller capacity") from error
            if isinstance(error, DamagedEpisodeError):
                raise
            raise DamagedEpisodeError(path, "it is missing") from error
        if not whole:
            raise DamagedEpisodeError(path, "it ended while it was read")

    def _key(self, number: int) -> tuple[int, str]:
        return number, self.records[number].sha256

    def _locate(self, number: int) -> EpisodeFile:
        record = self.records[number]
        return locate_episode(self.file(number), record, self._verified.stamp(record.sha256))


class EpisodeWriter(EpisodeStore):
    """A store that is locked for this process. Use it in a `with` statement.

    Entering repairs the traces of a kill: a truncated line of the index, a partial file, and a complete file without
    its line. An index that is lost, or ends in zeros, is rebuilt from the files, with a warning on stderr.

    `append` refuses what could not be read again, and episodes of another environment than that of the earlier ones.

    Raises:
        ForbesError: on entering, if another process writes to the folder.

    Example:
        >>> arrays = torch.zeros(11, 2).numpy(), torch.zeros(11, 1).numpy(), torch.zeros(11).numpy()
        >>> episode = forbes.Episode(*arrays, terminated=False, frames=10)
        >>> environment = {"task": "mine", "observation_shape": [2], "action_dim": 1, "discrete": False}
        >>> with forbes.EpisodeWriter("episodes/mine") as writer:
        ...     record = writer.append(episode, seed=0, policy="human", environment=environment)
        >>> record.number, record.steps
        (0, 10)
        >>> forbes.Replay("episodes/mine").size("train")
        11
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
            environment: task, `observation_shape`, `action_dim`, `discrete` and any settings, as plain values; of an
                `Environment`, the result of `describe_environment`.

        Raises:
            ForbesError: if the episode is invalid, is from another environment, or cannot be written.
        """
        if problem := problem_of(episode):
            raise self._not_stored(problem)
        number = self.watermark
        about = describe_episode(number, episode, seed, policy, environment)
        if problem := problem_with(about["environment"], episode):
            raise self._not_stored(problem)
        content = pack_episode(episode, about)
        record = EpisodeRecord(**about, size=len(content), sha256=hashlib.sha256(content).hexdigest())
        if problem := record.problem():
            raise self._not_stored(problem)
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

    def _not_stored(self, problem: str) -> ForbesError:
        return ForbesError(f"{self.file(self.watermark)}: not stored, {problem}. Fix the environment or the policy")

    def set_aside(self, watermark: int) -> int:
        """Go back to a checkpoint: move the episodes from this number on to `set_aside/`, and return their number.

        Raises:
            ForbesError: if the store has had fewer episodes, or has deleted some of those before.
        """
        if watermark > self.watermark:
            raise ForbesError(
                f"{self.path}: has {self.watermark} episodes, expected the {watermark} of the checkpoint. "
                "Name the folder of that run"
            )
        if 0 < watermark < self.index.first:
            raise ForbesError(
                f"{self.path}: its episodes before {self.index.first} were deleted, expected those before {watermark} "
                "of the checkpoint. Resume from a later one"
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
                map_episode(self.file(number), record)
            except DamagedEpisodeError as error:
                found[number] = error.reason
        return found

    def _tidy(self) -> None:
        """Move files that the index does not list to `set_aside/`, and delete those it has forgotten."""
        for number in self.files():
            if number < self.index.first:
                self.file(number).unlink()
            elif number not in self.records:
                _move(self.file(number), self.path / "set_aside")


def _move(path: Path, folder: Path) -> None:
    """Move a file to a folder, with a suffix if its name exists there."""
    folder.mkdir(exist_ok=True)
    target, copy = folder / path.name, 1
    while target.exists():
        copy += 1
        target = folder / f"{path.stem}-{copy}{path.suffix}"
    path.rename(target)
