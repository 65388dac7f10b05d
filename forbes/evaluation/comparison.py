"""Families of models side by side: what `forbes evaluate` has recorded of their runs, over seeds and paired.

A family is a configuration, trained under several seeds. Its score is the mean over its runs; the spread over runs says
what another seed would change. A difference of two families is taken per seed, over the same sequences.
"""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.measured import SCORES, score_of
from forbes.evaluation.record import read_arrays, read_record

__all__ = ["Comparison", "Family", "compare", "markdown"]


class Family(NamedTuple):
    """The runs of one configuration."""

    name: str
    runs: Mapping[int, str]
    """Run folders by seed."""


class Comparison(NamedTuple):
    """What was measured, as tables; nats per sequence."""

    scores: pd.DataFrame
    """A row for each family, metric and seed: mean, standard_error (over sequences), per_step, parameters, run."""
    differences: pd.DataFrame
    """A row for each family but the first, score and seed: mean and standard_error of family - first, paired."""
    curves: dict[str, dict[str, list[float]]]
    """By metric and family, the mean of each step over sequences and seeds."""


def compare(families: Sequence[Family], metrics: Sequence[str]) -> Comparison:
    """Collect what is recorded of runs that were measured on the same sequences.

    Raises:
        ForbesError: where a run lacks a metric, or was measured on other sequences than the first.
    """
    rows, curves = [], {}
    for metric in metrics:
        entries = {family.name: _entries(family, metric) for family in families}
        _require_same_data(metric, families, entries)
        curves[metric] = {
            name: np.mean([entry["curve"] for entry in of_runs], axis=0).tolist() for name, of_runs in entries.items()
        }
        rows += [
            _row(family, metric, seed, entry)
            for family in families
            for seed, entry in zip(family.runs, entries[family.name], strict=True)
        ]
    scores = [metric for metric in metrics if score_of(metric) in SCORES]
    differences = [
        difference for metric in scores for other in families[1:] for difference in _paired(other, families[0], metric)
    ]
    columns = ["family", "metric", "seed", "mean", "standard_error"]
    return Comparison(pd.DataFrame(rows), pd.DataFrame(differences, columns=columns), curves)


def _entries(family: Family, metric: str) -> list[dict[str, Any]]:
    entries = []
    for run in family.runs.values():
        record = read_record(run)
        if metric not in record:
            raise ForbesError(f"{run}: evaluation.json has no {metric}. Measure it: forbes evaluate {run}")
        entries.append(record[metric])
    return entries


def _require_same_data(
    metric: str, families: Sequence[Family], entries: Mapping[str, Sequence[dict[str, Any]]]
) -> None:
    expected = entries[families[0].name][0]["data"]
    for family in families:
        for run, entry in zip(family.runs.values(), entries[family.name], strict=True):
            if entry["data"]["sha256"] != expected["sha256"]:
                raise ForbesError(
                    f"{run}: {metric} was measured on {entry['data']['name']}, expected {expected['name']} as for "
                    f"{families[0].name}. Compare runs of the same data"
                )


def _row(family: Family, metric: str, seed: int, entry: dict[str, Any]) -> dict[str, Any]:
    measured = {name: entry[name] for name in ("mean", "standard_error", "parameters", "sequences")}
    per_step = entry["per_step"]["mean"]
    return {"family": family.name, "metric": metric, "seed": seed, **measured, "per_step": per_step} | {
        "run": family.runs[seed]
    }


def _paired(family: Family, first: Family, metric: str) -> list[dict[str, Any]]:
    """Give the paired differences of the seeds that both families have."""
    rows = []
    for seed in (seed for seed in family.runs if seed in first.runs):
        values = read_arrays(family.runs[seed])[metric] - read_arrays(first.runs[seed])[metric]  # (N,)
        difference = Estimate.of(torch.from_numpy(values))._asdict()
        rows.append({"family": family.name, "metric": metric, "seed": seed, **difference})
    return rows


def markdown(comparison: Comparison, families: Sequence[Family]) -> str:
    """Write the comparison as two tables: scores, and differences to the first family."""
    scores = comparison.scores.set_index(["metric", "family"]).sort_index()
    metrics = comparison.scores["metric"].unique()
    names = [family.name for family in families]
    parameters = [f"{scores.loc[(metrics[0], name), 'parameters'].iloc[0]:,}" for name in names]
    lines = ["Nats per sequence, mean over seeds [lowest, highest]; ess as a share of K.", ""]
    lines += _table(["metric", *names], [["parameters", *parameters]])
    for metric in metrics:
        column = "per_step" if score_of(metric) == "ess" else "mean"
        lines += _rows([[f"`{metric}`", *(_span(scores.loc[(metric, name), column].tolist()) for name in names)]])
    if len(comparison.differences):
        lines += ["", f"Paired over sequences, minus {names[0]}: mean ± standard error.", ""]
        differences = comparison.differences.set_index(["metric", "family", "seed"])
        pairs = list(dict.fromkeys(zip(comparison.differences["family"], comparison.differences["seed"], strict=True)))
        lines += _table(["score", *(f"{name}, seed {seed}" for name, seed in pairs)], [])
        for metric in comparison.differences["metric"].unique():
            each = [differences.loc[(metric, *pair)] for pair in pairs]
            lines += _rows([[f"`{metric}`", *(str(Estimate(one["mean"], one["standard_error"])) for one in each)]])
    return "\n".join(lines) + "\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [*_rows([header]), "|---|" + "---:|" * (len(header) - 1), *_rows(rows)]


def _rows(rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in rows]


def _span(values: Sequence[float]) -> str:
    mean = statistics.fmean(values)
    return f"{mean:.2f}" if len(values) == 1 else f"{mean:.2f} [{min(values):.2f}, {max(values):.2f}]"
