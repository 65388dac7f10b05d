"""Argument parsing for the commands that Lightning does not parse. Errors are one sentence."""

import argparse
import math
from typing import NoReturn

from forbes.choices import LONGEST
from forbes.errors import ForbesError

__all__ = ["ArgumentParser", "positive", "rate", "seconds"]


class ArgumentParser(argparse.ArgumentParser):
    """An `argparse.ArgumentParser` that keeps line breaks in its help and raises `ForbesError`."""

    def __init__(self, prog: str, description: str, epilog: str | None = None) -> None:
        raw = argparse.RawDescriptionHelpFormatter
        super().__init__(prog, description=description, epilog=epilog, formatter_class=raw)

    def error(self, message: str) -> NoReturn:
        """Raise `ForbesError` instead of printing the usage and exiting."""
        raise ForbesError(f"{self.prog}: {message}. See {self.prog} --help")


def positive(text: str) -> int:
    """Parse a positive integer (an argparse type)."""
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return int(text)


def rate(text: str) -> float:
    """Parse a positive number of steps per second (an argparse type)."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a number of steps per second above 0")
    return value


def seconds(text: str) -> float:
    """Parse a positive number of seconds (an argparse type)."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= LONGEST:
        raise argparse.ArgumentTypeError(f"{text} is not a number of seconds above 0, at most {LONGEST}")
    return value
