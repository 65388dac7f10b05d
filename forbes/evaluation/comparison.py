"""Compare families of models by the recorded results of `forbes evaluate`, over seeds and paired.

A family is a configuration trained with several seeds. Its score is the mean over its runs; their spread shows the
effect of the seed. The difference of two families is taken per seed, over the same sequences.
"""

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.metrics import SCORES, at_horizons, degradation, score_of
from forbes.evaluation.record import read_arrays, read_record
from forbes.evaluation.references import lowest_above, merge_equal

__all__ = ["Comparison", "Family", "compare", "markdown"]

_NEEDED = ("mean", "standard_error", "sequences", "per_step", "curve", "data")


class Family(NamedTuple):
    """The runs of one configuration."""

    name: str
    runs: Mapping[int, str]
    """Run folders by seed."""
    parameters: int
    """Number of parameters of each model."""
    lacks: Collection[str] = ()
    """Metrics that the models do not have."""


class Comparison(NamedTuple):
    """The scores of all families as tables, in nats per sequence."""

    scores: pd.DataFrame
    """One row per family, metric and seed: mean, standard_error (over sequences), per_step, parameters, run. The
    scores are empty if the family does not have the metric."""
    differences: pd.DataFrame
    """One row per family but the first, score and seed: mean and standard_error of the paired difference family -
    first, for the scores that both have."""
    curves: dict[str, dict[str, list[float]]]
    """Mean at each step over sequences and seeds, by metric and family; includes `degradation`."""
    references: dict[str, dict[str, float]]
    """Scores of models without a belief on the same sequences, by score and name."""


def compare(families: Sequence[Family], metrics: Sequence[str]) -> Comparison:
    """Collect the recorded results of runs that were evaluated on the same sequences.

    Raises:
        ForbesError: if a run lacks a metric, or was evaluated on other sequences than the first.
    """
    rows, curves = [], {}
    references: dict[str, dict[str, float]] = {}
    for metric in metrics:
        having = [family for family in families if metric not in family.lacks]
        entries = {family.name: _entries(family, metric) for family in having}
        _require_same_data(metric, having, entries)
        curves[metric] = {
            name: np.mean([entry["curve"] for entry in of_runs], axis=0).tolist() for name, of_runs in entries.items()
        }
        found = next(iter(entries.values()))[0].get("references", {})
        references |= {metric: {name: each["mean"] for name, each in found.items()}} if found else {}
        for family in families:
            own = entries.get(family.name) or [_blank(entries[having[0].name][0])] * len(family.runs)
            rows += [_row(family, metric, seed, entry) for seed, entry in zip(family.runs, own, strict=True)]
    curves |= degradation(curves)
    scores = [metric for metric in metrics if score_of(metric) in SCORES and metric not in families[0].lacks]
    others = [(metric, other) for metric in scores for other in families[1:] if metric not in other.lacks]
    differences = [difference for metric, other in others for difference in _paired(other, families[0], metric)]
    columns = ["family", "metric", "seed", "mean", "standard_error"]
    return Comparison(pd.DataFrame(rows), pd.DataFrame(differences, columns=columns), curves, references)


def _entries(family: Family, metric: str) -> list[dict[str, Any]]:
    entries = []
    for run in family.runs.values():
        record = read_record(run)
        if metric not in record:
            raise ForbesError(f"{run}: evaluation.json has no {metric}. Run: forbes evaluate {run}")
        if lacking := [field for field in _NEEDED if field not in record[metric]]:
            raise ForbesError(f"{run}: the {metric} of evaluation.json has no {lacking[0]}. Evaluate the run again")
        entries.append(record[metric])
    return entries


def _blank(other: dict[str, Any]) -> dict[str, Any]:
    """Return an empty entry for a metric that the model does not have, modelled on the entry of another run."""
    return other | {"mean": math.nan, "standard_error": math.nan, "per_step": {"mean": math.nan}}


def _require_same_data(
    metric: str, families: Sequence[Family], entries: Mapping[str, Sequence[dict[str, Any]]]
) -> None:
    first = entries[families[0].name][0]
    expected, steps = first["data"], len(first["curve"])
    for family in families:
        for run, entry in zip(family.runs.values(), entries[family.name], strict=True):
            if entry["data"]["sha256"] != expected["sha256"]:
                raise ForbesError(
                    f"{run}: {metric} was measured on {entry['data']['name']}, expected {expected['name']} as for "
                    f"{families[0].name}. Compare runs of the same data"
                )
            if len(entry["curve"]) != steps:
                raise ForbesError(f"{run}: {metric} was measured by another version of forbes. Evaluate all runs again")


def _row(family: Family, metric: str, seed: int, entry: dict[str, Any]) -> dict[str, Any]:
    return {
        "family": family.name,
        "metric": metric,
        "seed": seed,
        **{name: entry[name] for name in ("mean", "standard_error", "sequences")},
        "per_step": entry["per_step"]["mean"],
        "parameters": family.parameters,
        "run": family.runs[seed],
    }


def _paired(family: Family, first: Family, metric: str) -> list[dict[str, Any]]:
    """Return the paired differences of the seeds that both families have."""
    rows = []
    for seed in (seed for seed in family.runs if seed in first.runs):
        one, other = (_array(run, metric) for run in (family.runs[seed], first.runs[seed]))
        if one.shape != other.shape:
            raise ForbesError(
                f"{family.runs[seed]}: evaluation.npz has {len(one)} sequences of {metric}, {first.runs[seed]} "
                f"{len(other)}, expected the same. Evaluate both again"
            )
        values = one - other  # (N,)
        episodes = read_record(family.runs[seed])[metric].get("episode_of")
        difference = Estimate.of(torch.from_numpy(values), episodes)._asdict()
        rows.append({"family": family.name, "metric": metric, "seed": seed, **difference})
    return rows


def _array(run: str, metric: str) -> NDArray[np.float64]:
    """Return the score of each sequence, `(N,)`."""
    arrays = read_arrays(run)
    if metric not in arrays:
        raise ForbesError(f"{run}: evaluation.npz has no {metric}. Run: forbes evaluate {run}")
    return arrays[metric]


def markdown(comparison: Comparison, families: Sequence[Family]) -> str:
    """Return the comparison as Markdown tables: scores, references, differences to the first family, degradation."""
    scores = comparison.scores.set_index(["metric", "family"]).sort_index()
    metrics = comparison.scores["metric"].unique()
    names = [family.name for family in families]
    parameters = [f"{family.parameters:,}" for family in families]
    lines = ["Nats per sequence, mean over seeds [lowest, highest]; ess as a share of K.", ""]
    lines += _table(["metric", *names], [["parameters", *parameters]])
    for metric in metrics:
        column = "per_step" if score_of(metric) == "ess" else "mean"
        of_families = [scores.loc[[(metric, name)], column].tolist() for name in names]
        lines += _rows(
            [[f"`{metric}`", *(_span(v) + _below(v, comparison.references.get(metric, {})) for v in of_families)]]
        )
    if comparison.references:
        lines += ["", "Models without a belief on the same steps; <: the mean over seeds is below this one.", ""]
        of_references = next(iter(comparison.references.values()))
        lines += _table(["metric", *of_references], [])
        for metric, means in merge_equal(comparison.references).items():
            lines += _rows([[f"`{metric}`", *(f"{mean:.2f}" for mean in means.values())]])
    if len(comparison.differences):
        lines += ["", f"Paired over sequences, minus {names[0]}: mean ± standard error.", ""]
        differences = comparison.differences.set_index(["metric", "family", "seed"])
        pairs = list(dict.fromkeys(zip(comparison.differences["family"], comparison.differences["seed"], strict=True)))
        lines += _table(["score", *(f"{name}, seed {seed}" for name, seed in pairs)], [])
        for metric in comparison.differences["metric"].unique():
            each = [_difference(differences, (metric, *pair)) for pair in pairs]
            lines += _rows([[f"`{metric}`", *each]])
    for metric, curves in comparison.curves.items():
        if score_of(metric) == "degradation":
            rows = at_horizons(metric, curves)
            lines += ["", f"`{metric}`: nats that a prediction loses, by steps after the last observation.", ""]
            lines += _table(["steps", *map(str, next(iter(rows.values())))], [])
            lines += _rows([[name, *(f"{loss:.2f}" for loss in row.values())] for name, row in rows.items()])
    return "\n".join(lines) + "\n"


def _below(values: Sequence[float], references: Mapping[str, float]) -> str:
    """Return " < name" of the lowest reference above the mean of the values, or nothing."""
    name = lowest_above(statistics.fmean(values), references)
    return f" < {name}" if name else ""


def _difference(differences: pd.DataFrame, of: tuple[str, str, int]) -> str:
    return str(Estimate(*differences.loc[of, ["mean", "standard_error"]])) if of in differences.index else "n/a"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [*_rows([header]), "|---|" + "---:|" * (len(header) - 1), *_rows(rows)]


def _rows(rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in rows]


def _span(values: Sequence[float]) -> str:
    mean = statistics.fmean(values)
    if math.isnan(mean):
        return "n/a"
    return f"{mean:.2f}" if len(values) == 1 else f"{mean:.2f} [{min(values):.2f}, {max(values):.2f}]"
