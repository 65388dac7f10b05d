"""The arguments of `forbes compare`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive
from forbes.commands.parsers.evaluate import add_score_options

__all__ = ["parser"]

_DESCRIPTION = """\
Train configurations with several seeds, evaluate all runs on the same sequences, and compare them.

  forbes compare strokes/rssm strokes/forbes --seeds 3
  forbes compare strokes/rssm strokes/forbes -o runs/dejong -- --data.source.origin dejong

Each run has a folder DIR/NAME-SEED. Arguments after -- are passed to every `forbes fit`. Runs that have no scores yet
are then evaluated as by `forbes evaluate`. Writes comparison.csv, .json and .md, and figures: scores, per-step,
differences (to the first configuration). If interrupted, the same command resumes where it stopped.

  forbes compare strokes/{rssm,forbes,mixture} --seeds 5 --jobs 2     # two trainings at a time, a progress line each"""


def parser() -> ArgumentParser:
    """Return the parser of `forbes compare`."""
    command = ArgumentParser("forbes compare", _DESCRIPTION)
    command.add_argument(
        "configs", nargs="+", metavar="CONFIG", help="configurations, by name or path; differences are to the first one"
    )
    command.add_argument(
        "--seeds", type=positive, default=1, help="runs per configuration, with seeds 0, 1, … (default: 1)"
    )
    command.add_argument(
        *("-o", "--output"),
        type=Path,
        default=Path("runs/compare"),
        metavar="DIR",
        help="output folder (default: runs/compare)",
    )
    command.add_argument(
        "--jobs",
        type=positive,
        default=1,
        metavar="N",
        help="number of trainings in parallel, which share the CPU threads (default: 1)",
    )
    measures = command.add_argument_group("evaluation, as in forbes evaluate")
    add_score_options(measures)
    return command
