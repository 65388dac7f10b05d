"""The console to which commands print their tables."""

import sys

from rich.console import Console

__all__ = ["console"]


def console(width: int) -> Console:
    """Return a console as wide as the terminal; for output to a file, of `width` columns instead of rich's 80."""
    return Console(width=None if sys.stdout.isatty() else width)
