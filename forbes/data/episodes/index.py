"""The index of an episode store: lines that are appended, and rewritten as one file when many say nothing new."""

import json
from pathlib import Path
from typing import Any

from forbes.data.episodes.episode import EpisodeRecord
from forbes.errors import ForbesError
from forbes.files import append_whole, replace_file

__all__ = ["EpisodeIndex"]

_SPARE = 1000
"""Lines that an index may have beyond two for each episode before it is compacted."""
_COUNTS = ("watermark", "first", "forgotten_steps", "forgotten_frames")


class EpisodeIndex:
    """What `index.jsonl` says of a store; any number of processes may read while one writes.

    Each line is a JSON object: an `EpisodeRecord`, or one of ``{"set_aside_from": n}``, ``{"forgotten_before": n}``,
    ``{"quarantined": n}``. A compacted index is the records that are left and, at its end, ``{"compacted": {...}}``
    with the numbers below. An episode's line that is there twice changes nothing.

    Args:
        path: the file; it need not exist.

    Raises:
        ForbesError: where a line cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.refresh()

    def refresh(self) -> None:
        """Read the index again: another process may have added to it."""
        self.records: dict[int, EpisodeRecord] = {}
        """By number, the oldest first."""
        self.watermark = 0
        """The number that the next episode will have."""
        self.first = 0
        """Episodes before this number are forgotten."""
        self.forgotten_steps, self.forgotten_frames = 0, 0
        text = self.path.read_text(errors="replace") if self.path.is_file() else ""
        lines = text[: text.rfind("\n") + 1].splitlines()  # a kill may cut the last
        for place, line in enumerate(lines, start=1):
            try:
                self._follow(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
                reason = f" ({error})" if type(error) is ValueError else ""
                raise ForbesError(
                    f"{self.path}: line {place} is not a line of the index{reason}. Delete it; the episode's file stays"
                ) from error
        self.lines = len(lines)

    def _follow(self, line: dict[str, Any]) -> None:
        """Follow one line; raise a ValueError or the like where it is none."""
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
        elif event == "forgotten_before":
            self.first = max(self.first, _count(value))
            for number in [number for number in self.records if number < value]:
                record = self.records.pop(number)
                self.forgotten_steps += record.steps
                self.forgotten_frames += record.frames
        else:
            raise KeyError(event)

    def add(self, record: EpisodeRecord) -> None:
        """Take a record, unless its line is there twice: numbers only grow. Only `append` and `compact` write."""
        if problem := record.problem():
            raise ValueError(problem)
        if record.number < self.watermark:
            return
        if name := self.differs(record):
            raise ValueError(f"its {name} is not that of the episodes before")
        self.records[record.number] = record
        self.watermark = record.number + 1

    def differs(self, record: EpisodeRecord) -> str:
        """Name what an episode's environment has otherwise than that of the episodes here; empty where nothing."""
        ours, theirs = next(iter(self.records.values()), record).settings, record.settings
        return next((name for name in ours | theirs if ours.get(name) != theirs.get(name)), "")

    def append(self, line: dict[str, Any]) -> None:
        """Append a line, whole or not at all; when this returns, it survives a power loss."""
        append_whole(self.path, _encoded(line), sync=True)
        self._follow(line)
        self.lines += 1

    def is_lost(self) -> bool:
        """Tell whether the file has no whole line, or ends in zeros, as after a power loss on some disks."""
        content = self.path.read_bytes() if self.path.is_file() else b""
        whole, _, rest = content.rpartition(b"\n")
        return not whole or b"\0" in rest

    def compact_if_long(self) -> None:
        """Compact an index that has mostly lines of what is gone."""
        if self.lines > 2 * len(self.records) + _SPARE:
            self.compact()

    def compact(self) -> None:
        """Write what the index says with the fewest lines; at every instant the file is the old one or the new."""
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
