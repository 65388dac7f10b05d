"""The error that a user can fix: one sentence that says where, what and what to do."""

import errno
from collections.abc import Collection
from pathlib import Path
from typing import Any

__all__ = ["FULL", "ForbesError", "require_at_least", "require_one_of", "require_positive", "unwritable"]

FULL = {
    errno.ENOSPC: "Free some space, or choose another folder",
    errno.EDQUOT: "Free some space in your quota, or choose another folder",
    errno.EFBIG: "Allow larger files (ulimit -f unlimited), or choose another folder",
}
"""What to do if no more data can be stored, by error number."""


class ForbesError(Exception):
    """Invalid input or an invalid environment.

    The message is one sentence: where, what, what was expected, what to do. The command line prints it as
    `forbes: <message>` and exits with `exit_status`; `--debug` shows the traceback.

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


def require_positive(where: str, **numbers: float) -> None:
    """Raise a ForbesError unless every number is above 0."""
    for name, number in numbers.items():
        if not number > 0:
            raise ForbesError(f"{where}: {name} is {number}, expected more than 0. Choose another")


def require_one_of(options: Collection[str], where: str, **choices: str) -> None:
    """Raise a ForbesError for the first choice that is none of the options. The command line checks them by their type.

    Args:
        options: what may be chosen.
        where: the name that the sentence begins with, e.g. that of the class.
        **choices: arguments by name.

    Example:
        >>> forbes.errors.require_one_of(("masked", "observed"), "Strokes", end="seen")
        Traceback (most recent call last):
        ...
        forbes.errors.ForbesError: Strokes: end is 'seen', expected masked or observed. Choose one of them
    """
    for name, choice in choices.items():
        if choice not in options:
            raise ForbesError(f"{where}: {name} is {choice!r}, expected {' or '.join(options)}. Choose one of them")


def unwritable(path: Path | str, error: OSError) -> ForbesError:
    """Return the error for a file that cannot be written."""
    remedy = FULL.get(error.errno or 0, "Choose another folder")
    return ForbesError(f"{path}: cannot be written ({error.strerror}). {remedy}")
