"""The error a user can mend: one sentence that says what, where and what to do."""

import errno
from pathlib import Path
from typing import Any

__all__ = ["FULL", "ForbesError", "require_at_least", "unwritable"]

FULL = {
    errno.ENOSPC: "Make room, or choose another place",
    errno.EDQUOT: "Make room in your quota, or choose another place",
    errno.EFBIG: "Allow larger files (ulimit -f unlimited), or choose another place",
}
"""What to do where the system stores no more, by its number for the error."""


class ForbesError(Exception):
    """Bad input or a bad environment.

    The message is one clear sentence: where, what, what was expected, what to do. The command line prints it
    as ``forbes: <message>`` and exits with `exit_status`; ``--debug`` shows the traceback.

    Example:
        >>> forbes.Strokes(points_per_step=0)
        Traceback (most recent call last):
        ...
        forbes.errors.ForbesError: Strokes: points_per_step is 0, expected at least 1
    """

    exit_status = 2


def require_at_least(least: float, where: str, **numbers: Any) -> None:
    """Raise a ForbesError for the first number that is below a minimum, or is no number.

    Args:
        least: the minimum.
        where: the name that the sentence begins with, e.g. that of the class.
        **numbers: arguments by name; a configuration can set them to null.

    Example:
        >>> forbes.errors.require_at_least(1, "Strokes", points_per_step=0)
        Traceback (most recent call last):
        ...
        forbes.errors.ForbesError: Strokes: points_per_step is 0, expected at least 1
    """
    for name, number in numbers.items():
        if number is None or not number >= least:
            raise ForbesError(f"{where}: {name} is {number}, expected at least {least}")


def unwritable(path: Path | str, error: OSError) -> ForbesError:
    """Return the sentence for a file that cannot be written: which, why and what to do."""
    remedy = FULL.get(error.errno or 0, "Choose another place")
    return ForbesError(f"{path}: cannot be written ({error.strerror}). {remedy}")
