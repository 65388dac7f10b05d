"""Which files of an episode store were compared with their hashes, so that this is done once, not in every process."""

import json
from contextlib import suppress
from pathlib import Path

from forbes.data.episodes.episode import Stamp
from forbes.errors import ForbesError
from forbes.files import append_whole

__all__ = ["VerifiedFiles"]


class VerifiedFiles:
    """The content of `verified.jsonl`: `{"sha256": stamp}` of each file that had this hash at this stamp.

    Any process may append. A line that cannot be read, or a lost file, only means that episodes are hashed again.

    Args:
        path: the file; need not exist, and is not needed if it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamps: dict[str, Stamp] = {}
        for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
            try:
                self._stamps |= {sha256: _stamp(values) for sha256, values in json.loads(line).items()}
            except (ValueError, TypeError, AttributeError, RecursionError):
                continue

    def stamp(self, sha256: str) -> Stamp | None:
        """Return the stamp at which a file with this hash was verified last, if it was."""
        return self._stamps.get(sha256)

    def add(self, stamps: dict[str, Stamp]) -> None:
        """Record files that were verified at these stamps."""
        new = {sha256: stamp for sha256, stamp in stamps.items() if self._stamps.get(sha256) != stamp}
        self._stamps |= new
        if new:
            with suppress(ForbesError):  # the store may be somebody else's, or the disk full
                append_whole(self.path, json.dumps(new).encode() + b"\n")


def _stamp(values: list[int]) -> Stamp:
    size, written, changed, inode = map(int, values)
    return size, written, changed, inode
