"""Results of an evaluation in a run folder: `evaluation.json` for people, `evaluation.npz` for programs.

Both have one entry per metric. Its full name has the split (`test`, or `test[:1000]` for the first 1000 sequences),
the score, the likelihood and the number of samples: `test[:1000]/pll[bernoulli,K=128]`. Evaluating a metric again
replaces its entry.
"""

import fcntl
import io
import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from forbes.bundled import is_pretrained
from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate, bootstrap_interval
from forbes.evaluation.scoring import Scores
from forbes.files import no_link, remove_halves, replace_file
from forbes.reading import is_number, read_json, read_npz, shortened
from forbes.runs.folder import RunFolder

__all__ = ["describe", "read_arrays", "read_record", "require_readable", "results_folders", "write_record"]

_REMEDY = "Delete it and evaluate again"


def describe(scores: Scores, metric: str, episodes: Sequence[int] | None = None) -> dict[str, Any]:
    """Return the summary of a metric over sequences, in nats: its entry in `evaluation.json`.

    Args:
        scores: scores of the sequences.
        metric: name of the metric.
        episodes: number of the episode of each sequence, if several are of one.
    """
    values, steps, total = scores.values[metric], scores.steps, scores.total(metric)
    shares = {"minimum": 0.0, "5%": 0.05, "median": 0.5, "95%": 0.95, "maximum": 1.0}
    counts = scores.mask.sum(0)  # (T,)
    last = int(counts.nonzero().max()) + 1  # later steps are padding in all sequences
    return {
        **Estimate.of(total, episodes)._asdict(),
        "interval_95": bootstrap_interval(total, episodes),
        "per_step": Estimate.per_step(values.sum(1), steps, episodes)._asdict(),
        "curve": (values.sum(0) / counts.clamp(min=1))[:last].tolist(),
        "quantiles": {name: total.quantile(share).item() for name, share in shares.items()},
        "sequences": len(total),
        "steps": int(steps.sum()),
    } | ({} if episodes is None else {"episode_of": [*episodes]})


def results_folders(runs: Sequence[str], output: str | None = None) -> dict[str, Path]:
    """Return the folder for the results of each run.

    Args:
        runs: run folders, or checkpoints in them.
        output: parent folder, in which each run gets a folder of its name. Default: the run folder itself, or
            `pretrained-NAME` in the current folder for a model that comes with the package.

    Raises:
        ForbesError: if two runs would share a folder in `output`, or a folder is not writable.
    """
    folders: dict[str, Path] = {}
    for run in runs:
        folder = RunFolder(run)
        results = folder.results
        if output is not None:
            name = folder.path.resolve().name
            results = Path(output) / (name if results == folder.path else f"{name}-{folder.checkpoint.stem}")
            if results in folders.values():
                raise ForbesError(f"{run}: another run is called {name} too. Evaluate them with different --output")
        elif is_pretrained(run):
            results = Path(f"pretrained-{folder.path.name}")
        elif folder.path.is_dir() and not os.access(folder.path, os.W_OK):
            raise ForbesError(f"{run}: cannot be written to. Let the results go elsewhere: --output DIR")
        folders[run] = results
    return folders


def read_record(run: str | Path) -> dict[str, Any]:
    """Read `evaluation.json`; return an empty record for a run that was never evaluated.

    Raises:
        ForbesError: if it is not JSON, or an entry is not one that an evaluation writes.
    """
    path = RunFolder(run).results / "evaluation.json"
    if not path.exists():
        return {}
    record = read_json(path, _REMEDY)
    if not isinstance(record, dict):
        raise ForbesError(f"{path}: holds a {type(record).__name__}, expected entries by metric. {_REMEDY}")
    for name, entry in record.items():
        if not isinstance(entry, dict):
            raise ForbesError(f"{path}: {shortened(name, 80)} is no entry of an evaluation. {_REMEDY}")
        for field, fits in _FIELDS.items():
            if field in entry and not fits(entry[field]):
                raise ForbesError(f"{path}: the {field} of {shortened(name, 80)} is not one. {_REMEDY}")
    return record


def _is_estimate(value: Any) -> bool:
    """Return whether this is an `Estimate`, whose numbers are null if they are infinite."""
    if not isinstance(value, dict) or not {"mean", "standard_error"} <= value.keys():
        return False
    return all(value[name] is None or is_number(value[name]) for name in ("mean", "standard_error"))


_FIELDS: dict[str, Callable[[Any], bool]] = {
    "mean": lambda value: value is None or is_number(value),
    "standard_error": lambda value: value is None or is_number(value),
    "per_step": _is_estimate,
    "curve": lambda value: isinstance(value, list) and all(map(is_number, value)),
    "sequences": lambda value: isinstance(value, int),
    "seed": lambda value: isinstance(value, int),
    "checkpoint": lambda value: isinstance(value, str),
    "data": lambda value: (
        isinstance(value, dict) and all(isinstance(value.get(key), str) for key in ("name", "sha256"))
    ),
    "references": lambda value: isinstance(value, dict) and all(map(_is_estimate, value.values())),
}
"""Check of each field of an entry, if the entry has it. Readers rely on these."""


def require_readable(folders: Iterable[str | Path]) -> None:
    """Read the results of earlier evaluations, so that a damaged file is reported before minutes are spent."""
    for folder in folders:
        read_record(folder)
        read_arrays(folder)


def read_arrays(run: str | Path) -> dict[str, NDArray[np.float64]]:
    """Read `evaluation.npz`: the score of each sequence, `(N,)`, by metric. Empty before the first evaluation."""
    path = RunFolder(run).results / "evaluation.npz"
    if not path.exists():
        return {}
    arrays = read_npz(path, _REMEDY)
    for name, array in arrays.items():
        if array.dtype != np.float64 or array.ndim != 1:
            found = f"{array.dtype} {array.shape}"
            raise ForbesError(f"{path}: {shortened(name, 80)} is {found}, expected float64 (N,). {_REMEDY}")
    return arrays


def write_record(run: str | Path, entries: dict[str, dict[str, Any]], totals: dict[str, Tensor]) -> None:
    """Replace entries of `evaluation.json`, and the scores of each sequence, `(N,)`, in `evaluation.npz`.

    A lock makes concurrent evaluations wait for each other, so that no entry is lost.
    """
    folder = RunFolder(run).results
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".evaluation.lock", "a", opener=no_link) as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # until the file is closed
        remove_halves(folder, "evaluation.npz", "evaluation.json")
        record = read_record(run) | entries
        arrays = read_arrays(run) | {name: values.numpy() for name, values in totals.items()}
        content = io.BytesIO()
        np.savez(content, **arrays)
        replace_file(folder / "evaluation.npz", content.getvalue())
        replace_file(folder / "evaluation.json", (json.dumps(record, indent=2) + "\n").encode())
