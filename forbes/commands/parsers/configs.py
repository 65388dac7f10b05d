"""The arguments of `forbes configs`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser

__all__ = ["parser"]

_DESCRIPTION = """\
List the configurations that come with the package, show one, or copy one to change it.

  forbes configs
  forbes configs show strokes/forbes
  forbes configs copy strokes/forbes mine.yaml        # then: forbes fit mine.yaml

Wherever a command takes a configuration, it takes a name of this list or a path; a file of that name is preferred."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes configs`. Without a subcommand, `command` is None."""
    configs = ArgumentParser("forbes configs", _DESCRIPTION)
    commands = configs.add_subparsers(dest="command", metavar="COMMAND", parser_class=ArgumentParser)
    show, copy = (
        commands.add_parser(name, help=summary, description=summary)
        for name, summary in [("show", "Print a configuration."), ("copy", "Copy a configuration to a new file.")]
    )
    for command in (show, copy):
        command.add_argument("name", metavar="NAME", help="name of a configuration, e.g. strokes/forbes")
    copy.add_argument("path", metavar="PATH", type=Path, help="file to write, which must not exist")
    return configs
