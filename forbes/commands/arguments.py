"""Argument parsing for the commands that Lightning does not parse. Errors are one sentence."""

import argparse
import math
from typing import Any, NoReturn

from forbes.choices import LONGEST
from forbes.errors import ForbesError

__all__ = ["ArgumentParser", "RunsParser", "add_models", "existing_run", "positive", "rate", "seconds"]


class ArgumentParser(argparse.ArgumentParser):
    """An `argparse.ArgumentParser` that keeps line breaks in its help and raises `ForbesError`."""

    def __init__(self, prog: str, description: str, epilog: str | None = None) -> None:
        raw = argparse.RawDescriptionHelpFormatter
        super().__init__(prog, description=description, epilog=epilog, formatter_class=raw)

    def error(self, message: str) -> NoReturn:
        """Raise `ForbesError` instead of printing the usage and exiting."""
        raise ForbesError(f"{self.prog}: {message}. See {self.prog} --help")


class RunsParser(ArgumentParser):
    """The parser of a command on runs, and on models that were trained elsewhere."""

    def __init__(self, prog: str, description: str, runs: str) -> None:
        super().__init__(prog, description)
        self.add_argument("runs", nargs="*", metavar="RUN", type=existing_run, help=runs)
        add_models(self)

    def parse_args(self, *arguments: Any) -> argparse.Namespace:  # type: ignore[override]  # of its overloads, ours
        """Parse, and require a run or a model."""
        found: argparse.Namespace = super().parse_args(*arguments)
        found.model = found.model or []
        if not found.runs and not found.model:
            self.error("the following arguments are required: RUN, or --model MODULE:CLASS")
        return found


def add_models(parser: argparse._ActionsContainer) -> None:
    """Add the options for models that were trained elsewhere."""
    parser.add_argument(
        "--model",
        nargs="+",
        action="append",
        metavar=("MODULE:CLASS", "KEY=VALUE"),
        help="model trained elsewhere, by a forbes.ModelAdapter of the current folder, with arguments of its "
        "constructor; may be repeated (docs/score-your-model.md)",
    )
    parser.add_argument(
        "--data",
        metavar="DATA",
        help="data of --model: a configuration or a run folder (default: those of the first RUN)",
    )


def existing_run(text: str) -> str:
    """Return the name of a run folder that exists (an argparse type), so that a wrong one is reported at once.

    Raises:
        ForbesError: if there is no such folder.
    """
    from forbes.runs.folder import RunFolder  # imports numpy, which help pages do not need

    RunFolder.existing(text)
    return text


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
