"""Runs that were measured on the same sequences, and their differences."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor

from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import TrainedRun

__all__ = ["Measured", "Pair", "pair"]

_ALL_PAIRS = 4  # runs up to which every two are compared; of more, each with the first
_SCORES = ("elbo", "iwae", "pll", "fivo", "open_loop")
"""Of these more is better; the others are parts or diagnostics."""


class Measured(NamedTuple):
    """One run, measured."""

    run: TrainedRun
    entries: dict[str, dict[str, Any]]
    """For `evaluation.json`, by metric."""
    totals: dict[str, Tensor]
    """The score of each sequence, by metric, `(N,)`."""


class Pair(NamedTuple):
    """Two runs and the mean difference first - second of each score, over the same sequences."""

    first: Measured
    second: Measured
    differences: dict[str, Estimate]


def pair(measured: Sequence[Measured]) -> list[Pair]:
    """Compare every two runs, or where there are many each with the first, and note it in the entries of both."""
    pairs = []
    for first, second in itertools.combinations(measured, 2):
        if len(measured) > _ALL_PAIRS and first is not measured[0]:
            break
        differences = {}
        for name in first.totals:
            if name.partition("/")[2].partition("[")[0] not in _SCORES:
                continue
            difference = Estimate.of(first.totals[name] - second.totals[name])
            differences[name] = difference
            for one, other, sign in [(first, second, 1), (second, first, -1)]:
                noted = {"minus": other.run.path, "mean": sign * difference.mean}
                paired = one.entries[name].setdefault("paired", [])
                paired.append(noted | {"standard_error": difference.standard_error})
        pairs.append(Pair(first, second, differences))
    return pairs
