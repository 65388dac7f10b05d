"""Metrics of runs evaluated on the same sequences: their names, differences, and degradation.

**Degradation** is the loss of predictive log-likelihood with the horizon. To predict step t > c, the closed loop is
given o_1 to o_{t-1} (`pll`), the open loop o_1 to o_c (`open_loop_marginal`). The difference is
log p(o_t | o_{1:t-1}) - log p(o_t | o_{1:c}), in nats.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import TrainedRun

__all__ = [
    "SCORES",
    "EvaluatedRun",
    "Pair",
    "at_horizons",
    "compare_pairs",
    "degradation",
    "record_differences",
    "score_of",
]

_ALL_PAIRS = 4  # up to this many runs, all pairs are compared; with more runs, each is compared with the first
SCORES = ("elbo", "iwae", "pll", "fivo", "open_loop")
"""Scores for which higher is better. All other metrics are parts of them or diagnostics."""
_HORIZONS = (1, 2, 5, 10)

Curves = Mapping[str, Mapping[str, Sequence[float]]]
"""Mean at each step, `(T,)`, by metric, then by model."""


class EvaluatedRun(NamedTuple):
    """A run and its scores."""

    run: TrainedRun
    entries: dict[str, dict[str, Any]]
    """Entries of `evaluation.json`, by metric."""
    totals: dict[str, Tensor]
    """Score of each sequence, `(N,)`, by metric."""
    images: Mapping[str, dict[str, Any]] = {}
    """Entries of the PSNR and the SSIM; empty if they were not measured."""


class Pair(NamedTuple):
    """Two runs and the mean difference, first - second, of each score they share, over the same sequences."""

    first: EvaluatedRun
    second: EvaluatedRun
    differences: dict[str, Estimate]


def score_of(metric: str) -> str:
    """Return the score in a metric's full name, e.g. `pll` for `test[:1000]/pll[bernoulli,K=128]`."""
    return metric.rpartition("/")[2].partition("[")[0]


def compare_pairs(measured: Sequence[EvaluatedRun]) -> list[Pair]:
    """Compare all pairs of runs; with more than four runs, compare each with the first."""
    pairs = list(itertools.combinations(measured, 2))
    if len(measured) > _ALL_PAIRS:
        pairs = pairs[: len(measured) - 1]  # those with the first come first
    return [
        Pair(
            first,
            second,
            {
                name: Estimate.of(total - second.totals[name], first.entries[name].get("episode_of"))
                for name, total in first.totals.items()
                if score_of(name) in SCORES and name in second.totals
            },
        )
        for first, second in pairs
    ]


def record_differences(first: EvaluatedRun, second: EvaluatedRun, differences: dict[str, Estimate]) -> None:
    """Add the differences of a pair to the entries of both runs."""
    for name, difference in differences.items():
        for evaluated, other, sign in [(first, second, 1), (second, first, -1)]:
            mine = {"minus": other.run.path, "mean": sign * difference.mean}
            evaluated.entries[name].setdefault("paired", []).append(
                mine | {"standard_error": difference.standard_error}
            )


def degradation(curves: Curves) -> dict[str, dict[str, list[float]]]:
    """Return the closed-loop curves minus the open-loop curves of the same sequences; 0 within the context.

    The metric's name keeps the settings of the open loop: `test[:1000]/degradation[bernoulli,K=1000,c=15]`.
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
    """Return each model's degradation 1, 2, 5 and 10 steps after the context, and at the last step."""
    context = _context(metric)
    end = len(next(iter(curves.values()))) - context
    horizons = [*(horizon for horizon in _HORIZONS if horizon < end), end]
    return {name: {horizon: curve[context + horizon - 1] for horizon in horizons} for name, curve in curves.items()}


def _context(metric: str) -> int:
    return int(metric.rpartition("c=")[2].rstrip("]"))
