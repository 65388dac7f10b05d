"""`forbes complete`: draw completions of unfinished digits by one model."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from forbes.commands.parsers.complete import parser
from forbes.data import SequenceData
from forbes.errors import ForbesError
from forbes.evaluation.predictions import first_of_each_class, whole_sequences
from forbes.evaluation.runs import open_model
from forbes.figures.grids import require_only_images
from forbes.figures.prediction_grid import prediction_grid
from forbes.figures.style import save_figure
from forbes.seeding import forked

__all__ = ["main"]

_DRAWN = 10  # sequences, unless they are named


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    model, data, *_ = open_model(args.run)
    batch = whole_sequences(data, args.split, _index(args, data))
    with forked("cpu", args.seed):
        figure = prediction_grid(model, data, batch, args.context, args.samples)
    save_figure(figure, args.output)
    print(args.output)


def _index(args: Any, data: SequenceData) -> Tensor:
    """Return the sequences to draw, `(B,)`, int64; refuse data that cannot be drawn."""
    require_only_images(args.run, data.observation_shape, "Name a run on images")
    if args.context >= data.length:
        raise ForbesError(f"--context {args.context}: expected less than the length of the sequences, {data.length}")
    size = data.source.size(args.split)
    if size == 0:
        raise ForbesError(f"--split {args.split}: the data of {args.run} have no such sequences. Choose another split")
    for index in args.index or ():
        if not 0 <= index < size:
            raise ForbesError(f"--index {index}: the {args.split} split has {size} sequences, expected 0 to {size - 1}")
    return first_of_each_class(data, args.split, _DRAWN) if args.index is None else torch.tensor(args.index)
