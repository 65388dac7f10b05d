"""The arguments of `forbes figures`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, add_models, positive
from forbes.figures.catalogue import find_figure

__all__ = ["OPTIONS", "parser"]

_DESCRIPTION = """\
Draw a figure of the paper from run folders, as PNG and PDF. It may be given by its number.

  forbes figures list
  forbes figures predictions --runs runs/compare/forbes-0 runs/compare/rssm-0 -o figures
  forbes figures 5 --runs runs/compare/forbes-{0,1,2} runs/compare/rssm-{0,1,2} -o figures

Runs that differ only in the seed form a family. It is drawn as the mean and range over its runs; predictions are those
of the first. A family trained with another bound than the ELBO is drawn with that bound, as the legend states.
elbo, per-step and prequential draw what a run has recorded; its checkpoints may be gone.

The digits of Figure 4, unless given by --index, are the most ambiguous of each class among the first 500 test digits,
by the labels of the 50 nearest training digits. The choice does not depend on any model."""

OPTIONS = ("index", "samples", "mean", "context", "model", "data")
"""Options that belong to some figures only. They are None unless given; defaults are those of the figure."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes figures`."""
    command = ArgumentParser("forbes figures", _DESCRIPTION)
    command.add_argument("name", metavar="NAME", type=_name, help="figure, its number in the paper, or list")
    command.add_argument("--runs", nargs="+", metavar="RUN", help="run folders written by `forbes fit`")
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="output folder (default: figures)")
    some = command.add_argument_group("options of some figures")
    add_models(some)
    some.add_argument("--index", type=int, nargs="+", help="indices of the test sequences to draw")
    some.add_argument("--samples", type=positive, help="completions of each sequence (predictions: 6, simcore: 4)")
    some.add_argument(
        "--mean", action="store_true", default=None, help="draw pixel probabilities of written strokes, not samples"
    )
    some.add_argument("--context", type=positive, help="frames that the models see (15; reconstructions: 5)")
    return command


def _name(text: str) -> str:
    """Return the name of a figure, given by its name or number (an argparse type)."""
    return text if text == "list" else find_figure(text).name
