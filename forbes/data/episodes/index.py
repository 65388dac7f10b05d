"""The index of an episode store: lines are appended; when many are obsolete, the file is rewritten."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from forbes.data.episodes.episode import EpisodeRecord
from forbes.errors import ForbesError
from forbes.files import append_whole, replace_file

__all__ = ["EpisodeIndex", "first_held"]

_SPARE = 1000
"""Number of lines in excess of two per episode before an index is compacted."""
_COUNTS = ("watermark", "first", "forgotten_steps", "forgotten_frames")


class EpisodeIndex:
    """The content of `index.jsonl`. Any number of processes may read it while one writes.

    Each line is a JSON object: an `EpisodeRecord`, or one of `{"set_aside_from": n}`, `{"forgotten_before": n}`,
    `{"quarantined": n}`. A compacted index has the remaining records and, at its end, `{"compacted": {...}}` with the
    counts below. A duplicate line of an episode has no effect.

    Args:
        path: the file; need not exist.

    Raises:
        ForbesError: if a line cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.refresh()

    def refresh(self) -> None:
        """Read the index again, since another process may have extended it."""
        self.records: dict[int, EpisodeRecord] = {}
        """Records by number, the oldest first."""
        self.watermark = 0
        """Number of the next episode."""
        self.first = 0
        """Episodes before this number are deleted."""
        self.forgotten_steps, self.forgotten_frames = 0, 0
        text = self.path.read_text(errors="replace") if self.path.is_file() else ""
        lines = text[: text.rfind("\n") + 1].splitlines()  # a kill may truncate the last line
        for line_number, line in enumerate(lines, start=1):
            try:
                self._apply(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
                reason = f" ({error})" if type(error) is ValueError else ""
                raise ForbesError(
                    f"{self.path}: line {line_number} is not a line of the index{reason}. Delete it; the episode's "
                    "file is kept"
                ) from error
        self.lines = len(lines)

    def _apply(self, line: dict[str, Any]) -> None:
        """Apply one line to the state; raise a ValueError or similar if it is invalid."""
        if "number" in line:
            self.add(EpisodeRecord(**line))
            return
        if len(line) != 1:
            raise KeyError(*line)
        ((event, value),) = line.items()
        if event == "compacted":
            for name in _COUNTS:
                setattr(self, name, max(getattr(self, name), _count(value[name])))
        elif event == "quarantined":
            self.records.pop(_count(value), None)
        elif event == "set_aside_from":
            self.watermark = min(self.watermark, _count(value))
            self.records = {number: record for number, record in self.records.items() if number < value}
            if self.watermark == 0:  # a new start, of which nothing was forgotten
                self.first = self.forgotten_steps = self.forgotten_frames = 0
        elif event == "forgotten_before":
            self.first = max(self.first, _count(value))
            for number in [number for number in self.records if number < value]:
                record = self.records.pop(number)
                self.forgotten_steps += record.steps
                self.forgotten_frames += record.frames
        else:
            raise KeyError(event)

    def add(self, record: EpisodeRecord) -> None:
        """Add a record, without writing it, unless it is a duplicate: numbers only grow."""
        if problem := record.problem():
            raise ValueError(problem)
        if record.number < self.watermark:
            return
        if name := self.differs(record):
            raise ValueError(f"its {name} is not that of the previous episodes")
        self.records[record.number] = record
        self.watermark = record.number + 1

    def differs(self, record: EpisodeRecord) -> str:
        """Return the first setting in which an episode's environment differs from this store's, or an empty string."""
        ours, theirs = next(iter(self.records.values()), record).settings, record.settings
        return next((name for name in ours | theirs if ours.get(name) != theirs.get(name)), "")

    def append(self, line: dict[str, Any]) -> None:
        """Append a line atomically. After the return it survives a power loss."""
        append_whole(self.path, _encoded(line), sync=True)
        self._apply(line)
        self.lines += 1

    def is_lost(self) -> bool:
        """Return whether the file has no complete line, or ends in zeros, as after a power loss on some disks."""
        content = self.path.read_bytes() if self.path.is_file() else b""
        whole, _, rest = content.rpartition(b"\n")
        return not whole or b"\0" in rest

    def compact_if_long(self) -> None:
        """Compact an index if most of its lines are obsolete."""
        if self.lines > 2 * len(self.records) + _SPARE:
            self.compact()

    def compact(self) -> None:
        """Rewrite the index atomically with as few lines as possible."""
        counts = {"compacted": {name: getattr(self, name) for name in _COUNTS}}
        lines = [*(record._asdict() for record in self.records.values()), counts]
        replace_file(self.path, b"".join(map(_encoded, lines)))
        self.lines = len(lines)


def _encoded(line: dict[str, Any]) -> bytes:
    return json.dumps(line).encode() + b"\n"


def _count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise TypeError(value)
    return value


def first_held(records: Iterable[EpisodeRecord], capacity: int | None) -> int:
    """Return the number of the oldest episode within `capacity` agent steps. The latest one is always included."""
    first, steps = 0, 0
    for record in reversed(list(records)):
        steps += record.steps
        if capacity is not None and first and steps > capacity:
            return first
        first = record.number
    return first
