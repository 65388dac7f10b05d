"""What changes in a run folder, to keep a copy of it on another machine up to date without sending all of it again."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from stat import S_ISREG
from typing import TypeAlias

from forbes.files import replace_file

__all__ = ["Stamp", "changes", "stamps", "write_changes"]

Stamp: TypeAlias = tuple[int, int, int]
"""Number, time and size of a file. One of them changes whenever its content does."""


def stamps(run: str) -> dict[str, Stamp]:
    """Return the stamp of each file of a run folder by its path: the checkpoints first, the others sorted."""
    found: dict[str, Stamp] = {}
    for path in sorted(Path(run).rglob("*"), key=lambda path: (path.parent.name != "checkpoints", path)):
        with suppress(FileNotFoundError):  # deleted since it was listed
            stat = path.stat()
            if S_ISREG(stat.st_mode) and not path.name.startswith("."):
                found[path.relative_to(run).as_posix()] = stat.st_ino, stat.st_mtime_ns, stat.st_size
    return found


def changes(run: str, known: dict[str, Stamp]) -> dict[str, bytes | None]:
    """Return the content of the files that are not as they were known, None for deleted ones, and update `known`.

    Checkpoints are read first, so that the metrics are not older.
    """
    now = stamps(run)
    found: dict[str, bytes | None] = dict.fromkeys(name for name in known if name not in now)
    for name in [name for name, stamp in now.items() if stamp != known.get(name)]:
        try:
            found[name] = Path(run, name).read_bytes()
        except FileNotFoundError:
            found[name] = None
    known.clear()
    known.update(now)
    return found


def write_changes(folder: Path, files: Mapping[str, bytes | None]) -> None:
    """Make the changes in a copy. If it is killed meanwhile, the last checkpoint there has all that it needs.

    Checkpoints are written after all others, and files deleted at the end, since an older checkpoint may need them.
    """
    for name, content in reversed([*files.items()]):
        if content is None:
            (folder / name).unlink(missing_ok=True)
        else:
            replace_file(folder / name, content)
