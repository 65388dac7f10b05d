"""The arguments of `forbes doctor`."""

from forbes.commands.arguments import ArgumentParser

__all__ = ["parser"]


def parser() -> ArgumentParser:
    """Return the parser of `forbes doctor`."""
    return ArgumentParser("forbes doctor", "Say what this machine has and lacks, each lack with its remedy.")
