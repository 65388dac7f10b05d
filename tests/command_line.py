"""Calls of `forbes` that must fail."""

from forbes.commands.cli import main

__all__ = ["error_of"]


def error_of(capsys, *arguments):
    """Return the one sentence of a command that must fail, without `forbes: `; progress may come before it."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    *progress, line = capsys.readouterr().err.splitlines()
    assert all(each.endswith(" sequences") for each in progress)
    assert line.startswith("forbes: ")
    return line.removeprefix("forbes: ")
