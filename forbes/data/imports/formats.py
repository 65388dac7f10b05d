"""Find the reader of a format. It is imported when it is used."""

import importlib
from pathlib import Path

from forbes.choices import FORMATS
from forbes.data.imports.reader import Reader
from forbes.data.imports.source import REMEDY
from forbes.errors import ForbesError
from forbes.reading import readable

__all__ = ["open_reader"]


def open_reader(path: Path, name: str | None = None) -> Reader:
    """Open recorded episodes.

    Args:
        path: file or folder.
        name: name of the format. Default: the first one that recognises the path.

    Raises:
        ForbesError: if no format recognises it, it is damaged, or a library is missing.
    """
    if name is None:
        if not path.exists():
            raise ForbesError(f"{path}: no such file or folder")
        if (path / "index.jsonl").is_file():
            raise ForbesError(
                f"{path}: is an episode store already. Read it with Replay, or with: forbes data info {path}"
            )
        with readable(path, "a format of recorded episodes", REMEDY):
            name = next((name for name in FORMATS if _reader(name).recognises(path)), None)
    if name is None:
        raise ForbesError(f"{path}: no format recognises it. Name one: --format {'|'.join(FORMATS)}")
    with readable(path, name, REMEDY):
        return _reader(name)(path)


def _reader(name: str) -> type[Reader]:
    module, kind = FORMATS[name].split(":")
    reader: type[Reader] = getattr(importlib.import_module(f"forbes.data.imports.{module}"), kind)
    return reader
