"""The arguments of `forbes doctor`."""

from forbes.commands.arguments import ArgumentParser

__all__ = ["parser"]


def parser() -> ArgumentParser:
    """Return the parser of `forbes doctor`."""
    return ArgumentParser(
        "forbes doctor", "Report this machine's software, hardware and data, with a remedy for each problem."
    )
