"""Arguments of the commands that Lightning does not parse: what is wrong with them is said in one sentence."""

import argparse
from typing import Literal, NoReturn, TypeAlias

from forbes.errors import ForbesError

__all__ = ["ArgumentParser", "Dataset", "Fetched", "Origin", "Split", "positive"]

Split: TypeAlias = Literal["train", "validation", "test"]
Dataset: TypeAlias = Literal["strokes"]
Fetched: TypeAlias = Literal["strokes", "curves"]
Origin: TypeAlias = Literal["bundled", "dejong"]
"""A set of strokes."""


class ArgumentParser(argparse.ArgumentParser):
    """An `argparse.ArgumentParser` that keeps line breaks in its help and raises `ForbesError`."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter)

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage and leaving."""
        raise ForbesError(f"{self.prog}: {message}. See {self.prog} --help")


def positive(text: str) -> int:
    """Parse a number that counts something; for `type=`."""
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return int(text)
