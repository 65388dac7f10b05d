"""Exported runs: a small run folder to share, with rounded weights, but without the optimizer."""

import json
import re
from collections.abc import Mapping
from typing import Any

from lightning import LightningModule
from torch import Tensor

from forbes.errors import ForbesError
from forbes.files import replace_file, require_no_links
from forbes.runs.checkpoint import compressed_checkpoint, open_checkpoint, read_checkpoint
from forbes.runs.folder import RunFolder
from forbes.runs.modules import build_run
from forbes.runs.provenance import read_provenance
from forbes.runs.worlds import check_weights, weights_of

__all__ = ["EXPORTED", "export_run", "shareable"]

EXPORTED = "exported_from"
"""Key of an exported checkpoint: the SHA-256 of the checkpoint that it was made from."""
_KEPT = ("epoch", "global_step", "pytorch-lightning_version", "hyper_parameters")


def export_run(run: RunFolder, output: RunFolder) -> tuple[str, str]:
    """Write a run's model, configuration, provenance and metrics.

    The matrices, which are nearly all parameters, are rounded to bfloat16; the module that loads them computes in its
    own precision. Biases and buffers are stored as they are. Absolute paths lose their folders.

    Args:
        run: run to export.
        output: folder to write. It may hold an earlier export of the same checkpoint, whose weights are kept.

    Returns:
        SHA-256 of the run's checkpoint, and of the exported one.

    Raises:
        ForbesError: if the run cannot be loaded or a file in it is a link, or if the output holds another run.
    """
    require_no_links((run.config, run.provenance, run.metrics))  # they would bring other files into the export
    file = open_checkpoint(run.checkpoint)
    state = weights_of(file.content, str(run.checkpoint))
    module, _, _ = build_run(run)
    check_weights(module, state, str(run.checkpoint))
    if _is_free(output, file.sha256):
        content = {key: file.content[key] for key in _KEPT if key in file.content}
        content |= {"state_dict": _small(state, module), EXPORTED: file.sha256}
        replace_file(output.checkpoint, compressed_checkpoint(content))
    replace_file(output.config, run.config.read_bytes())
    if run.provenance.is_file():
        entries = [_without_machine(entry) for entry in read_provenance(run.provenance)]
        replace_file(output.provenance, json.dumps(shareable(entries), indent=2).encode() + b"\n")
    if run.metrics.is_file():
        replace_file(output.metrics, run.metrics.read_bytes())
    return file.sha256, open_checkpoint(output.checkpoint).sha256


def shareable(value: Any) -> Any:
    """Return a value of a JSON file in which absolute paths have lost their folders: /home/me/runs/a becomes a."""
    if isinstance(value, list):
        return [shareable(each) for each in value]
    if isinstance(value, dict):
        return {key: shareable(each) for key, each in value.items()}
    return re.sub(r"(?<![^\s='\"(])/(?:[^\s/'\"]+/)+", "", value) if isinstance(value, str) else value


def _is_free(output: RunFolder, source: str) -> bool:
    """Return whether a folder is free, or already holds this checkpoint's export; refuse anything else in it."""
    if output.checkpoint.is_file():
        if read_checkpoint(output.checkpoint).get(EXPORTED) != source:
            raise ForbesError(f"{output}: holds another run. Choose another folder: -o DIR")
        return False
    if output.path.exists() and any(output.path.iterdir()):
        raise ForbesError(f"{output}: has other files, expected an empty or new folder. Choose another: -o DIR")
    return True


def _small(state: Mapping[str, Tensor], module: LightningModule) -> dict[str, Tensor]:
    """Return the matrices in bfloat16, and everything else as it is."""
    matrices = {name for name, values in module.named_parameters() if values.dim() > 1}
    return {name: values.bfloat16() if name in matrices else values.clone() for name, values in state.items()}


def _without_machine(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of provenance.json without the name of the machine."""
    machine = entry.get("machine")
    kept = {key: value for key, value in machine.items() if key != "name"} if isinstance(machine, dict) else machine
    return {**entry, "machine": kept}
