"""The arguments of `forbes compare`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive
from forbes.commands.parsers.evaluate import add_score_options

__all__ = ["parser"]

_DESCRIPTION = """\
Train configurations under several seeds, measure all of them on the same sequences, and compare.

  forbes compare configs/strokes/rssm.yaml configs/strokes/forbes.yaml --seeds 3
  forbes compare configs/strokes/rssm.yaml configs/strokes/forbes.yaml -o runs/dejong -- --data.source.origin dejong

Each run is a folder DIR/NAME-SEED; what follows -- is given to each `forbes fit`. Then `forbes evaluate` measures what
has not been measured yet. Writes comparison.csv, .json and .md, and pictures: scores, per-step, differences (to the
first configuration). Interrupted, the same command goes on where it stopped, for days if need be.

  forbes compare configs/strokes/*.yaml --seeds 5 --jobs 2      # two trainings side by side, a progress line each"""


def parser() -> ArgumentParser:
    """Return the parser of `forbes compare`."""
    command = ArgumentParser("forbes compare", _DESCRIPTION)
    command.add_argument(
        "configs", nargs="+", metavar="CONFIG", help="configurations; the others are held to the first"
    )
    command.add_argument("--seeds", type=positive, default=1, help="runs of each, seeds 0, 1, … (default: 1)")
    command.add_argument(
        "-o", "--output", type=Path, default=Path("runs/compare"), metavar="DIR", help="default: runs/compare"
    )
    command.add_argument(
        "--jobs",
        type=positive,
        default=1,
        metavar="N",
        help="trainings at a time, sharing the threads (default: 1)",
    )
    measures = command.add_argument_group("how they are measured, as for forbes evaluate")
    add_score_options(measures)
    return command
