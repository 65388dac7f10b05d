"""Metrics of runs that were measured on the same sequences: their names, differences, and degradation.

**Degradation** is how much worse a prediction becomes with the horizon. Of step t > c the closed loop has seen o_1 to
o_{t-1} (`pll`), the open loop o_1 to o_c (`open_loop_marginal`). The difference is
log p(o_t | o_{1:t-1}) - log p(o_t | o_{1:c}), in nats.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import TrainedRun

__all__ = ["SCORES", "EvaluatedRun", "Pair", "at_horizons", "degradation", "note", "pair", "score_of"]

_ALL_PAIRS = 4  # runs up to which every two are compared; of more, each with the first
SCORES = ("elbo", "iwae", "pll", "fivo", "open_loop")
"""Of these more is better; the others are parts or diagnostics."""
_HORIZONS = (1, 2, 5, 10)

Curves = Mapping[str, Mapping[str, Sequence[float]]]
"""By metric, then by model, the mean of each step, `(T,)`."""


class EvaluatedRun(NamedTuple):
    """One run, measured."""

    run: TrainedRun
    entries: dict[str, dict[str, Any]]
    """For `evaluation.json`, by metric."""
    totals: dict[str, Tensor]
    """The score of each sequence, by metric, `(N,)`."""


class Pair(NamedTuple):
    """Two runs and the mean difference first - second of each score that both have, over the same sequences."""

    first: EvaluatedRun
    second: EvaluatedRun
    differences: dict[str, Estimate]


def score_of(metric: str) -> str:
    """Return the score of a full name: `test[:1000]/pll[bernoulli,K=128]` to `pll`."""
    return metric.partition("/")[2].partition("[")[0]


def pair(measured: Sequence[EvaluatedRun]) -> list[Pair]:
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


def note(first: EvaluatedRun, second: EvaluatedRun, differences: dict[str, Estimate]) -> None:
    """Note the differences of a pair in the entries of both."""
    for name, difference in differences.items():
        for one, other, sign in [(first, second, 1), (second, first, -1)]:
            mine = {"minus": other.run.path, "mean": sign * difference.mean}
            one.entries[name].setdefault("paired", []).append(mine | {"standard_error": difference.standard_error})


def degradation(curves: Curves) -> dict[str, dict[str, list[float]]]:
    """Subtract the open-loop curves from the closed-loop ones of the same sequences; 0 within the context.

    Its name has the numbers of the open loop: `test[:1000]/degradation[bernoulli,K=1000,c=15]`.
    """
    found = {}
    for metric, open_loop in curves.items():
        split, _, tag = metric.partition("/open_loop_marginal[")
        closed_loop = next((name for name in curves if name.startswith(f"{split}/pll[")), None)
        if tag and closed_loop:
            context = _context(metric)
            found[f"{split}/degradation[{tag}"] = {
                name: [0.0] * context + np.subtract(curves[closed_loop][name], curve)[context:].tolist()
                for name, curve in open_loop.items()
            }
    return found


def at_horizons(metric: str, curves: Mapping[str, Sequence[float]]) -> dict[str, dict[int, float]]:
    """Return, by model, what the degradation is 1, 2, 5, 10 steps after the context, and at the end."""
    context = _context(metric)
    end = len(next(iter(curves.values()))) - context
    horizons = [*(horizon for horizon in _HORIZONS if horizon < end), end]
    return {name: {horizon: curve[context + horizon - 1] for horizon in horizons} for name, curve in curves.items()}


def _context(metric: str) -> int:
    return int(metric.rpartition("c=")[2].rstrip("]"))
