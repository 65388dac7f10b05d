"""The arguments of `forbes completions`."""

from pathlib import Path
from typing import get_args

from forbes.choices import Split
from forbes.commands.arguments import ArgumentParser, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Let models complete the beginnings of digits, and let classifiers read what they have drawn.

  forbes completions runs/compare/forbes-0 runs/compare/rssm-0 -o figures

Completions are read at the step at which the true digit ends; models learn no sign of the end, and are told none.

  JS, entropy   distribution of the class over completions, against that of a calibrated classifier of beginnings, the
                reference r(y | o_1..c)
  -log p, ECE   the same distribution against the true class
  clear digits  share of completions that a classifier of digits gives more than 0.9 for one class
  class kept    of the completions whose class was clear after 60 % (80 %) of the rest, those that end in this class
  energy, CRPS  proper scores of the pixels, drawn from the grey values: jointly, and each on its own
  grey ink      share of the ink with a grey value between 0.1 and 0.9
  error         squared, in pixels: of one completion, of the best of N, and of the average picture of N

Beside the models: similar digits, the N training digits that begin most alike, in place of completions; and the true
digits, which bound what concerns one completion and have no diversity. Writes completions.json and .csv, and pictures,
a drawing for each length of the beginning. On one core, a run takes some 80 seconds for each hundred digits."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes completions`."""
    command = ArgumentParser("forbes completions", _DESCRIPTION)
    command.add_argument("runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made, of strokes")
    command.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    command.add_argument(
        "--sequences", "--digits", type=positive, default=300, help="the first so many of the split (default: 300)"
    )
    command.add_argument("--samples", type=positive, default=100, help="N, completions of each digit (default: 100)")
    command.add_argument(
        "--prefixes", type=positive, nargs="+", default=[5, 10, 15], help="steps that models see (default: 5 10 15)"
    )
    command.add_argument("--seed", type=int, default=0, help="of the completions (default: 0)")
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="folder (default: figures)")
    return command
