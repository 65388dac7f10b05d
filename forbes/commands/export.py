"""`forbes export`: a small folder with the model of a run, its scores and a model card."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning import LightningModule

from forbes.bundled import PRETRAINED, bundled, is_pretrained
from forbes.commands.parsers.export import parser
from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.record import read_record
from forbes.evaluation.references import best_reference
from forbes.evaluation.runs import data_name
from forbes.files import replace_file
from forbes.runs.exported import export_run, shareable
from forbes.runs.folder import RunFolder
from forbes.runs.modules import LoadedRun, open_module
from forbes.runs.provenance import read_provenance

__all__ = ["main"]

Entries = dict[str, dict[str, Any]]
"""Entries of `evaluation.json`, by metric."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    run = RunFolder.trained(args.run)
    folder = args.output or Path("exported") / run.path.resolve().name
    if is_pretrained(folder) or folder.suffix == ".ckpt":
        raise ForbesError(f"-o {folder}: is not the name of a folder that can be written. Choose another")
    output = RunFolder(folder)
    source, exported = export_run(run, output)
    scores = _of(read_record(run.checkpoint), source) | _of(read_record(output.path), exported)
    replace_file(output.path / "evaluation.json", json.dumps(shareable(scores), indent=2).encode() + b"\n")
    loaded = open_module(output.path, LightningModule, "forbes evaluate")  # the export can be loaded
    replace_file(output.path / "README.md", _card(output, loaded, scores).encode())
    print(f"{output}: {output.checkpoint.stat().st_size / 1e6:.2f} MB of weights. Measure it: forbes evaluate {output}")


def _of(record: Entries, checkpoint: str) -> Entries:
    """Return the entries of a checkpoint."""
    return {name: entry for name, entry in record.items() if entry.get("checkpoint") == checkpoint}


def _card(output: RunFolder, loaded: LoadedRun[Any], scores: Entries) -> str:
    """Return the model card in Markdown."""
    name = output.path.resolve().name
    comes_with_the_package = output.path.resolve().parent == bundled("pretrained").resolve()
    return _CARD.format(
        name=name,
        place=f"{PRETRAINED}{name}" if comes_with_the_package else name,
        training=_table(("", ""), _training(output, loaded)),
        scores=_scores(scores, loaded.checkpoint),
    )


_CARD = """\
# {name}

A model trained with `forbes`, exported by `forbes export`. Use it wherever a run folder is expected:

    forbes evaluate {place}

or in Python: `world, data = forbes.load_run("{place}")`.

## Training

{training}
## Scores

{scores}
## Limits

- The model knows sequences like those of its data only. Longer ones were not seen in training.
- It is one training run with one seed. Differences between models include the spread over seeds.
- Matrices are rounded to bfloat16, 8 significant bits. The optimizer is missing, so the training cannot be resumed.
"""


def _training(output: RunFolder, loaded: LoadedRun[Any]) -> Iterator[tuple[str, str]]:
    """Yield the facts about the training, by name."""
    model = loaded.config["model"]
    belief = model["init_args"].get("belief")
    kinds = [model["class_path"], *([belief["class_path"]] if isinstance(belief, dict) else [])]
    yield "model", " with ".join(f"`{kind}`" for kind in kinds)
    yield "parameters", f"{sum(parameter.numel() for parameter in loaded.module.parameters()):,}"
    yield "data", shareable(data_name(loaded.data))
    for start in read_provenance(output.provenance) if output.provenance.is_file() else []:
        machine = start.get("machine") or {}
        yield "command", f"`{start.get('command')}`"
        yield "commit", f"`{start.get('commit')}`"
        yield "seed", str(start.get("seed"))
        yield "SHA-256 of the data", f"`{start.get('data_sha256')}`"
        yield "began", str(start.get("started"))
        yield "hours", f"{start.get('hours')}, {machine.get('gpu') or 'CPU'}, threads: {machine.get('threads')}"
        yield "versions", ", ".join(f"{package} {version}" for package, version in start.get("versions", {}).items())


def _scores(entries: Entries, exported: str) -> str:
    """Return a table of the scores, each with the best reference on the same sequences."""
    measured = {name: entry for name, entry in entries.items() if isinstance(entry.get("mean"), float)}
    if not measured:
        return "None were recorded. Measure them with `forbes evaluate`, and export again.\n"
    rows = [
        (
            f"`{name}`",
            _estimate(entry),
            _best(entry),
            "exported" if entry["checkpoint"] == exported else "before rounding",
        )
        for name, entry in measured.items()
    ]
    header = ("score", "mean ± standard error", "best reference without a belief", "weights")
    return "Nats per sequence (returns and R² of agents: as named).\n\n" + _table(header, rows)


def _estimate(entry: Mapping[str, Any]) -> str:
    return str(Estimate(entry["mean"], entry["standard_error"]))


def _best(entry: Mapping[str, Any]) -> str:
    """Return the reference with the highest score, and whether it is above the model's."""
    if (name := best_reference(entry)) is None:
        return ""
    reference = entry["references"][name]
    above = " (higher)" if reference["mean"] > entry["mean"] else ""
    return f"{name}: {_estimate(reference)}{above}"


def _table(header: Sequence[str], rows: Iterator[Sequence[str]] | Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
