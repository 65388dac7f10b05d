"""What an evaluation leaves in a run folder: `evaluation.json` for people, `evaluation.npz` for programs.

Both hold one entry for each split that was evaluated; evaluating it again replaces the entry. The entries of the first
so many sequences are named after them: `test[:1000]`.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.errors import ForbesError
from forbes.evaluation.elbo import Bound, Estimate
from forbes.files import replace_file

__all__ = ["bound_metrics", "read_record", "summary", "write_record"]


def bound_metrics(bound: Bound, split: str, likelihood: str, samples: int) -> dict[str, Estimate]:
    """Name the bound and its parts: the likelihood and the number of samples belong to the name."""
    tag = f"[{likelihood},S={samples}]"
    return {
        f"{split}/elbo{tag}": Estimate.of(bound.elbo),
        f"{split}/elbo_per_step{tag}": bound.per_step(),
        f"{split}/reconstruction{tag}": Estimate.of(bound.reconstruction),
        f"{split}/kl{tag}": Estimate.of(bound.kl),
    }


def summary(bound: Bound) -> dict[str, float]:
    """Describe the spread of the ELBO over sequences, in nats."""
    shares = {"minimum": 0.0, "5%": 0.05, "median": 0.5, "95%": 0.95, "maximum": 1.0}
    elbo = bound.elbo.numpy()
    return {name: float(np.quantile(elbo, share)) for name, share in shares.items()} | {"std": float(elbo.std(ddof=1))}


def read_record(run: str) -> dict[str, Any]:
    """Read `evaluation.json`; a run that was never evaluated has an empty one."""
    path = Path(run) / "evaluation.json"
    if not path.exists():
        return {}
    try:
        record: dict[str, Any] = json.loads(path.read_text())
    except ValueError as error:
        raise ForbesError(f"{path}: not JSON ({error}). Delete it and evaluate again") from error
    return record


def write_record(run: str, split: str, entry: dict[str, Any], bound: Bound) -> None:
    """Replace the entry of a split in `evaluation.json`, and its per-sequence values in `evaluation.npz`."""
    record = read_record(run) | {split: entry}
    arrays = _read_arrays(Path(run) / "evaluation.npz")
    arrays |= {f"{split}/{name}": values.numpy() for name, values in bound._asdict().items()}
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]  # numpy's stub takes the names for options
    replace_file(Path(run) / "evaluation.npz", content.getvalue())
    replace_file(Path(run) / "evaluation.json", (json.dumps(record, indent=2) + "\n").encode())


def _read_arrays(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read the per-sequence values, none before the first evaluation."""
    if not path.exists():
        return {}
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)
