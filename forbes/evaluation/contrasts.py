"""Measure the contrast of a claim from the records of runs, seed by seed."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from forbes.errors import ForbesError
from forbes.evaluation.claims import Claim
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.metrics import score_of
from forbes.evaluation.record import read_arrays, read_record
from forbes.reading import is_number, read_json

__all__ = ["Runs", "contrast", "entry_of", "task_of"]

Runs = Mapping[tuple[str, int], str]
"""Folders of finished runs by family and seed."""


def entry_of(run: str, score: str) -> tuple[str, dict[str, Any]] | None:
    """Return the newest entry of a score in a run's record, with its full name; None if there is none."""
    entries = [(name, entry) for name, entry in read_record(run).items() if score_of(name) == score]
    return max(entries, key=lambda found: str(found[1].get("date", "")), default=None)


def contrast(claim: Claim, runs: Runs, completions: Mapping[int, Path]) -> dict[int, Estimate]:
    """Return the difference that tests a claim for each seed, positive if it agrees with the claim.

    Args:
        claim: claim with its families.
        runs: finished runs. Seeds that lack one of the families are left out.
        completions: `completions.json` of each seed.

    Raises:
        ForbesError: if runs that are compared were measured on different sequences.
    """
    found = {}
    for seed in sorted({seed for _, seed in runs}):
        if not all((family, seed) in runs for family in claim.families):
            continue
        if claim.score in ("clear", "js"):
            difference = _completed(claim, completions.get(seed))
        else:
            difference = _paired(claim, {family: runs[family, seed] for family in claim.families})
        if difference is not None:
            found[seed] = difference
    return found


def _paired(claim: Claim, runs: Mapping[str, str]) -> Estimate | None:
    """Return the mean difference over the sequences of all families; None if one was not measured.

    Families of one task have the same sequences, and are paired. Tasks are independent, and are summed.
    """
    scores = {family: values for family, run in runs.items() if (values := _scores(run, claim.score)) is not None}
    if len(scores) < len(runs):
        return None
    _require_same_data(claim, runs)
    tasks: dict[str, NDArray[np.float64]] = {}
    for family in claim.families:
        task, sign = task_of(family), 1 if family in claim.plus else -1
        tasks[task] = tasks.get(task, 0.0) + claim.sign * sign * scores[family]
    if (order := _order(claim, runs)) is None:
        return None
    episodes = {task_of(family): _episodes(run, claim.score) for family, run in runs.items()}
    estimates = [Estimate.of(torch.from_numpy(values), episodes[task]) for task, values in tasks.items()]
    mean, error = sum(one.mean for one in estimates), math.hypot(*(one.standard_error for one in estimates))
    return Estimate(order * mean, error)


def _order(claim: Claim, runs: Mapping[str, str]) -> float | None:
    """Return -1 if the first family has the lower score `ordered_by`, else 1; None if one was not measured."""
    if not claim.ordered_by:
        return 1.0
    first, second = (_scores(runs[side[0]], claim.ordered_by) for side in (claim.plus, claim.minus))
    return None if first is None or second is None else math.copysign(1.0, first.mean() - second.mean())


def task_of(family: str) -> str:
    """Return the task of a family: its name up to the slash."""
    return family.partition("/")[0]


def _scores(run: str, score: str) -> NDArray[np.float64] | None:
    """Return the score of each sequence or episode, `(N,)`."""
    found = entry_of(run, score)
    return None if found is None else read_arrays(run).get(found[0])


def _episodes(run: str, score: str) -> Sequence[int] | None:
    """Return the episode of each sequence, if several are of one."""
    _, entry = entry_of(run, score) or ("", {})
    found: Sequence[int] | None = entry.get("episode_of")
    return found


def _require_same_data(claim: Claim, runs: Mapping[str, str]) -> None:
    """Refuse runs of one task that were measured on different data. Agents are measured in their environment."""
    seen: dict[str, tuple[str, Any]] = {}
    for family, run in runs.items():
        name, entry = entry_of(run, claim.score) or ("", {})
        about = name, entry.get("data"), entry.get("seed")
        other, expected = seen.setdefault(task_of(family), (run, about))
        if about != expected:
            raise ForbesError(
                f"{run}: its {claim.score} was measured otherwise than that of {other}. Evaluate both again"
            )


def _completed(claim: Claim, path: Path | None) -> Estimate | None:
    """Return the difference that `forbes completions` has recorded, of the first run minus the second."""
    if path is None or not path.is_file():
        return None
    for entry in read_json(path, "Delete it, and repeat the command")["scores"]:
        if entry["minus"] is not None and score_of(entry["metric"]) == claim.score:
            mean, error = entry["mean"], entry["standard_error"]
            return Estimate(claim.sign * mean, error) if is_number(mean) and is_number(error) else None
    return None
