"""Read files that may be damaged. Errors are one sentence: which file, what is wrong, what to do."""

import gzip
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from forbes.errors import ForbesError

__all__ = ["is_number", "read_json", "read_npz", "read_yaml", "readable", "shortened"]

_REASON = 120  # characters of a parser's message


@contextmanager
def readable(path: Path | str, kind: str, remedy: str, raises: type[ForbesError] = ForbesError) -> Iterator[None]:
    """Turn any error of a parser on damaged bytes into one sentence.

    Parsers raise errors of any class on invalid bytes. So all errors are caught, and the `with` block should contain
    nothing but parsing.

    Args:
        path: file that is parsed.
        kind: expected format, e.g. "JSON".
        remedy: what to do about it; the last sentence of the error message.
        raises: class of the error to raise.

    Raises:
        ForbesError: for any error inside the `with` block.
    """
    try:
        yield
    except ForbesError:
        raise
    except Exception as error:
        reason = shortened(str(error), _REASON) or type(error).__name__
        raise raises(f"{path}: truncated or not {kind} ({reason}). {remedy}") from error


def shortened(text: str, length: int) -> str:
    """Return a text as one line of at most `length` characters."""
    line = " ".join(text.split())
    return line if len(line) <= length else line[: length - 1] + "…"


def is_number(value: object) -> bool:
    """Return whether a value of a JSON file is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def read_json(path: Path, remedy: str) -> Any:
    """Read a JSON file, compressed if its name ends in `.gz`."""
    content = path.read_bytes()
    with readable(path, "JSON", remedy):
        return json.loads(gzip.decompress(content) if path.suffix == ".gz" else content)


def read_yaml(path: Path, remedy: str) -> Any:
    """Read a YAML file of plain values."""
    content = path.read_bytes()
    with readable(path, "YAML", remedy):
        return yaml.safe_load(content)


def read_npz(path: Path, remedy: str) -> dict[str, NDArray[Any]]:
    """Read all arrays of an `.npz` file."""
    content = path.read_bytes()
    with readable(path, "an .npz file", remedy), np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return {str(name): arrays[name] for name in arrays}
