"""The arguments of `forbes reproduce`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser
from forbes.commands.parsers.launchers import add_launcher_options

__all__ = ["BUDGETS", "PARTS", "parser"]

PARTS = ("strokes", "processes", "control")
BUDGETS = ("smoke", "small", "paper")

_DESCRIPTION = """\
Train, measure and draw what the paper claims, and write one page: DIR/report/index.html.

  forbes reproduce --budget smoke                      # minutes: shows that everything works, is no evidence
  forbes reproduce                                     # three hours on two cores
  forbes reproduce --budget paper --dry-run            # what it would train, and the hours of each training
  forbes reproduce --only strokes --budget paper --yes

The page has the figures, tables of scores, and each claim of the paper with our number: holds, in direction only, does
not hold, or not tested. The verdict follows from the paired differences of the seeds by the rule on the page. Commands,
seeds, commits and hours of all numbers are on it too.

strokes: world models of digit strokes. processes: world models and beliefs of processes whose exact belief is known.
control: agents on the mountain hike, and with --budget paper on DeepMind Control.

If interrupted, the same command resumes where it stopped. A job that fails does not stop the others; the page names
it, and the exit status is 2."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes reproduce`."""
    command = ArgumentParser("forbes reproduce", _DESCRIPTION)
    command.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to train (default: all)")
    command.add_argument("--budget", choices=BUDGETS, default="small", help="how much to train (default: small)")
    add_launcher_options(command, "one per core, at most 4; with a GPU 1; measurements run here too")
    command.add_argument(
        *("-o", "--output"),
        type=Path,
        metavar="DIR",
        help="output folder (default: runs/reproduce/BUDGET)",
    )
    command.add_argument("--dry-run", action="store_true", help="list the trainings with their hours, and stop")
    command.add_argument("--yes", action="store_true", help="do not ask before the trainings of --budget paper")
    return command
