"""The arguments of `forbes completions`."""

from pathlib import Path
from typing import get_args

from forbes.choices import Split
from forbes.commands.arguments import RunsParser, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Complete the beginnings of digits with trained models, and score the completions with digit classifiers.

  forbes completions runs/compare/forbes-0 runs/compare/rssm-0 -o figures

Completions are classified at the step at which the true digit ends. Models do not learn where digits end, and draw on,
unless they are trained with --data.source.end observed.

  JS, entropy   class distribution over completions, compared with that of a calibrated classifier of prefixes, the
                reference r(y | o_1..c)
  -log p, ECE   the same distribution, scored by the true class
  clear digits  fraction of completions with a class probability above 0.9; also of the digits that end within the
                training length, beyond which a model draws what it was not trained for
  class kept    of the completions with a clear class after 60 % (80 %) of the remaining steps, the fraction that end
                in this class
  energy, CRPS  proper scores of the pixels sampled from the grey values, jointly and individually
  grey ink      fraction of the ink with a grey value between 0.1 and 0.9
  error         squared error in pixels: of one completion, of the best of N, and of the average image of N

Three rows are for comparison: completions by a 5-gram of pen moves, which has seen no image; similar digits, the N
training digits with the most similar beginnings, in place of completions; and the true digits, a bound for the scores
of single completions, without diversity. Writes completions.json and .csv, and figures, including drawings for each
prefix length. A run takes about 80 seconds per hundred digits on one core."""


def parser() -> RunsParser:
    """Return the parser of `forbes completions`."""
    command = RunsParser("forbes completions", _DESCRIPTION, "run folder of strokes, written by `forbes fit`")
    command.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    command.add_argument("--sequences", "--digits", type=positive, default=300, help="number of digits (default: 300)")
    command.add_argument("--samples", type=positive, default=100, help="completions per digit, N (default: 100)")
    command.add_argument(
        "--prefixes", type=positive, nargs="+", default=[5, 10, 15], help="steps that models see (default: 5 10 15)"
    )
    command.add_argument("--seed", type=int, default=0, help="random seed for the completions (default: 0)")
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="output folder (default: figures)")
    return command
