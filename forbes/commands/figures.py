"""`forbes figures`: list the paper's figures, and draw them from run folders."""

import argparse
from collections.abc import Sequence

from rich import box
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.figures import OPTIONS, parser
from forbes.errors import ForbesError
from forbes.figures.catalogue import FIGURES, draw

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    options = _given(args)
    if args.name == "list":
        if options or args.runs:
            raise ForbesError("forbes figures list: it draws nothing, so it has no options. Name a figure instead")
        console(80).print(_table())
        return
    if not args.runs and not args.model:
        raise ForbesError(f"forbes figures {args.name}: no runs to draw. Name some: --runs RUN")
    print(*draw(args.name, args.runs or [], args.output, **options), sep="\n")


def _given(args: argparse.Namespace) -> dict[str, object]:
    """Return the options of single figures that were given."""
    return {name: value for name in OPTIONS if (value := getattr(args, name)) is not None}


def _table() -> Table:
    """Return the table of all figures."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for header in ("name", "paper", "shows", "from runs of"):
        table.add_column(header, overflow="fold", no_wrap=header in ("name", "paper"))
    for figure in FIGURES:
        table.add_row(figure.name, figure.number, figure.shows, figure.runs)
    return table
