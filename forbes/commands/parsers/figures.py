"""The arguments of `forbes figures`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Draw the paper's figures from run folders, each as PNG and PDF.

  forbes figures strokes --runs runs/compare/forbes-0 runs/compare/rssm-0 -o figures
  forbes figures agents --runs runs/hike/forbes-{0,1,2} runs/hike/dreamer-{0,1,2} -o figures

agents: returns, what agents of one task earn without exploration against env steps. Runs whose folders differ in the
number at the end only are one curve, their mean and range; it is called as they are, forbes and dreamer here.

strokes: predictions-t30 (Figure 4), the same rolled on to the end of the longest digit, and elbo (Figure 5). Runs that
differ in their seed only are one family: Figure 4 shows the first of them, Figure 5 their mean and range. A family that
is trained by another bound than the ELBO is drawn by that one, and the legend says so.
Digits of Figure 4, unless --index names others: of the first 500 test digits, for each class the one whose beginning
leaves its class most open, judged by the labels of its 50 nearest training digits. No model has a say in the choice."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes figures`."""
    command = ArgumentParser("forbes figures", _DESCRIPTION)
    command.add_argument("experiment", choices=["strokes", "agents"], help="whose figures")
    command.add_argument(
        "--runs", nargs="+", required=True, metavar="RUN", help="run folders that `forbes fit` has made"
    )
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="folder (default: figures)")
    command.add_argument("--index", type=int, nargs="+", help="test digits of Figure 4")
    command.add_argument("--samples", type=positive, default=6, help="completions of each digit (default: 6)")
    command.add_argument(
        "--mean", action="store_true", help="of written strokes, how likely each pixel is on, in place of a drawing"
    )
    command.add_argument("--context", type=positive, default=15, help="frames that the models see (default: 15)")
    return command
