"""The arguments of `forbes figures`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Draw the paper's figures from run folders, each as PNG and PDF.

  forbes figures strokes --runs runs/compare/forbes-0 runs/compare/rssm-0 -o figures
  forbes figures agents --runs runs/hike/forbes-{0,1,2} runs/hike/dreamer-{0,1,2} -o figures

agents: returns, the returns of agents on one task without exploration against env steps. Runs whose folder names
differ only in the number at the end form one curve, their mean and range, named after the folders (here forbes and
dreamer).

strokes: predictions-t30 (Figure 4), the same predictions up to the end of the longest digit, and elbo (Figure 5). Runs
that differ only in the seed form a family: Figure 4 shows the first of them, Figure 5 their mean and range. A family
trained with another bound than the ELBO is drawn with that bound, as the legend states.
The digits of Figure 4, unless given by --index, are the most ambiguous of each class among the first 500 test digits,
by the labels of the 50 nearest training digits. The choice does not depend on any model."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes figures`."""
    command = ArgumentParser("forbes figures", _DESCRIPTION)
    command.add_argument("experiment", choices=["strokes", "agents"], help="experiment to draw")
    command.add_argument("--runs", nargs="+", required=True, metavar="RUN", help="run folders written by `forbes fit`")
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="output folder (default: figures)")
    command.add_argument("--index", type=int, nargs="+", help="indices of the test digits in Figure 4")
    command.add_argument("--samples", type=positive, default=6, help="completions per digit (default: 6)")
    command.add_argument(
        "--mean", action="store_true", help="for written strokes, draw pixel probabilities instead of samples"
    )
    command.add_argument("--context", type=positive, default=15, help="frames that the models see (default: 15)")
    return command
