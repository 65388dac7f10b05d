"""The arguments of `forbes complete`."""

from pathlib import Path
from typing import get_args

from forbes.choices import Split
from forbes.commands.arguments import ArgumentParser, existing_run, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Draw how a trained model completes the beginnings of digits, or of other sequences of images.

  forbes complete pretrained:strokes-forbes -o picture.png
  forbes complete runs/compare/forbes-0 -o picture.png --index 3 5 8 --context 10

Each row is a sequence: the truth, three of the frames that the model sees, and N sampled completions at the training
length and, if a sequence is longer, at the end of the longest. Each column of completions is one trajectory.
`forbes completions` scores completions, and draws those of several models."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes complete`."""
    command = ArgumentParser("forbes complete", _DESCRIPTION)
    command.add_argument(
        "run", metavar="RUN", type=existing_run, help="run folder written by `forbes fit`, or a checkpoint in it"
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="picture, .png or .pdf")
    command.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    command.add_argument(
        "--index", type=int, nargs="+", help="sequences of the split to draw (default: the first of each class)"
    )
    command.add_argument("--context", type=positive, default=15, help="frames that the model sees (default: 15)")
    command.add_argument("--samples", type=positive, default=6, help="completions per sequence, N (default: 6)")
    command.add_argument("--seed", type=int, default=0, help="random seed for the completions (default: 0)")
    return command
