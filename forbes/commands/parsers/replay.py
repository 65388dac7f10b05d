"""The arguments of `forbes replay`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser

__all__ = ["parser"]

_DESCRIPTION = """\
Show where a training diverged.

  forbes replay runs/strokes/forbes/20260101-120000-0/failure.pt

A training that diverges writes failure.pt: the weights before the update whose loss or gradient is not finite, its
batches and the seed of its noise. This command recomputes the update and names the first tensor that is not finite: a
field of the batch, a parameter, the output of a module, a term of the loss, or the gradient of a parameter. On a device
other than that of the training the noise differs."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes replay`."""
    command = ArgumentParser("forbes replay", _DESCRIPTION)
    command.add_argument("failure", type=Path, metavar="FAILURE", help="RUN/failure.pt, next to RUN/config.yaml")
    return command
