"""Runs that were measured on the same sequences, and their differences."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor

from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import TrainedRun

__all__ = ["SCORES", "Measured", "Pair", "note", "pair", "score_of"]

_ALL_PAIRS = 4  # runs up to which every two are compared; of more, each with the first
SCORES = ("elbo", "iwae", "pll", "fivo", "open_loop")
"""Of these more is better; the others are parts or diagnostics."""


class Measured(NamedTuple):
    """One run, measured."""

    run: TrainedRun
    entries: dict[str, dict[str, Any]]
    """For `evaluation.json`, by metric."""
    totals: dict[str, Tensor]
    """The score of each sequence, by metric, `(N,)`."""


class Pair(NamedTuple):
    """Two runs and the mean difference first - second of each score that both have, over the same sequences."""

    first: Measured
    second: Measured
    differences: dict[str, Estimate]


def score_of(metric: str) -> str:
    """Return the score of a full name: `test[:1000]/pll[bernoulli,K=128]` to `pll`."""
    return metric.partition("/")[2].partition("[")[0]


def pair(measured: Sequence[Measured]) -> list[Pair]:
    """Compare every two runs, or where there are many each with the first."""
    pairs = list(itertools.combinations(measured, 2))
    if len(measured) > _ALL_PAIRS:
        pairs = pairs[: len(measured) - 1]  # those with the first come first
    return [
        Pair(
            first,
            second,
            {
                name: Estimate.of(total - second.totals[name])
                for name, total in first.totals.items()
                if score_of(name) in SCORES and name in second.totals
            },
        )
        for first, second in pairs
    ]


def note(first: Measured, second: Measured, differences: dict[str, Estimate]) -> None:
    """Note the differences of a pair in the entries of both."""
    for name, difference in differences.items():
        for one, other, sign in [(first, second, 1), (second, first, -1)]:
            mine = {"minus": other.run.path, "mean": sign * difference.mean}
            one.entries[name].setdefault("paired", []).append(mine | {"standard_error": difference.standard_error})
