"""`forbes configs`: list, show and copy the configurations that come with the package."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.configs import parser
from forbes.errors import ForbesError
from forbes.files import replace_file
from forbes.runs.configs import find_config, shipped_configs

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    if args.command == "show":
        print(find_config(args.name).read_text(), end="")
    elif args.command == "copy":
        _copy(args.name, args.path)
    else:
        console(80).print(_table())


def _table() -> Table:
    """Return a table of all configurations, grouped by folder, each with the first sentence of its comment."""
    table = Table("configuration", "what it is", box=SIMPLE, padding=(0, 1))
    for folder, group in itertools.groupby(shipped_configs().items(), lambda item: item[0].rpartition("/")[0]):
        table.add_section()
        if folder:
            table.add_row(f"[bold]{folder}/[/bold]", "")
        for name, path in group:
            table.add_row(f"  {name.rpartition('/')[2]}" if folder else name, escape(_first_sentence(path)))
    table.caption = "Train with one: forbes fit strokes/forbes"
    return table


def _first_sentence(path: Path) -> str:
    """Return the first sentence of the comment that a configuration begins with."""
    lines = itertools.takewhile(lambda line: line.startswith("# "), path.read_text().splitlines())
    comment = " ".join(line.removeprefix("# ") for line in lines)
    return re.split(r"(?<=\.)\s", comment)[0]


def _copy(name: str, path: Path) -> None:
    """Copy a configuration to a new file, whose comment then has the command for the new file."""
    text = find_config(name).read_text()
    if path.exists():
        raise ForbesError(f"{path}: exists already. Name a new file")
    replace_file(path, text.replace(f"forbes fit {name}", f"forbes fit {path}").encode())
    print(f"{path}: a copy of {name}. Train with it: forbes fit {path}")
