"""The arguments of `forbes export`."""

from pathlib import Path

from forbes.bundled import PRETRAINED, pretrained_names
from forbes.commands.arguments import ArgumentParser, existing_run

__all__ = ["parser"]

_DESCRIPTION = """\
Export the model of a run to a small folder that can be shared.

  forbes export runs/compare/forbes-0 -o shared/forbes
  forbes evaluate shared/forbes
  forbes export runs/compare/forbes-0 -o shared/forbes      # again: the model card now has the scores of the export

The folder is a run folder, so every command accepts it, but it cannot be resumed: it has no optimizer. It holds

  checkpoints/last.ckpt  the weights, about 1.4 bytes per parameter: matrices are rounded to bfloat16
  config.yaml            the configuration
  provenance.json        command, commit, versions and hours, without the machine's name and the folders of paths
  metrics.jsonl          the metrics of the training
  evaluation.json        the recorded scores of the run's checkpoint, later those of the exported one
  README.md              the model card

These trained models come with the package, and can be used wherever a run folder can: {names}"""


def parser() -> ArgumentParser:
    """Return the parser of `forbes export`."""
    names = ", ".join(f"{PRETRAINED}{name}" for name in pretrained_names()) or "none"
    command = ArgumentParser("forbes export", _DESCRIPTION.format(names=names))
    command.add_argument(
        "run", metavar="RUN", type=existing_run, help="run folder written by `forbes fit`, or a checkpoint in it"
    )
    command.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder to write (default: exported/NAME-OF-RUN)"
    )
    return command
