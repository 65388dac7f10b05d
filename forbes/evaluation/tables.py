"""The tables that `forbes evaluate` prints."""

import itertools
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from forbes.evaluation.degradation import at_horizons, degradation
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.measured import Measured, Pair

__all__ = ["print_degradation", "print_pairs", "print_runs"]


def print_runs(measured: Sequence[Measured]) -> None:
    """Print every metric of every run; n/a where its model does not have it."""
    table = Table(title="scores in nats per sequence, mean ± standard error over sequences; ess as a share of K")
    for header in ("run", "family"):
        table.add_column(header, overflow="fold")
    table.add_column("parameters", justify="right")
    names = _union(one.entries for one in measured)
    for name in names:
        table.add_column(_header(name), justify="right")
    for one in measured:
        cells = [_cell(name, one.entries[name]) if name in one.entries else "n/a" for name in names]
        table.add_row(escape(one.run.path), one.run.family, f"{one.run.parameters:,}", *cells)
    _console().print(table)


def print_pairs(pairs: Sequence[Pair]) -> None:
    """Print the paired difference of every metric of which more is better; n/a where a model does not have it."""
    table = Table(title="paired difference over the same sequences, in nats per sequence; (in standard errors)")
    for header in ("run", "minus"):
        table.add_column(header, overflow="fold")
    names = _union(one.differences for one in pairs)
    for name in names:
        table.add_column(_header(name), justify="right")
    for first, second, differences in pairs:
        cells = [_difference(differences[name]) if name in differences else "n/a" for name in names]
        table.add_row(escape(first.run.path), escape(second.run.path), *cells)
    _console().print(table)


def print_degradation(measured: Sequence[Measured]) -> None:
    """Print what the open loop loses to the closed one, for every run that has both scores."""
    curves: dict[str, dict[str, list[float]]] = {}
    for one in measured:
        for name, entry in one.entries.items():
            curves.setdefault(name, {})[one.run.path] = entry["curve"]
    for metric, of_runs in degradation(curves).items():
        rows = at_horizons(metric, of_runs)
        table = Table(title=f"{escape(metric)}: nats a prediction loses so many steps after the last one seen")
        table.add_column("run", overflow="fold")
        for horizon in next(iter(rows.values())):
            table.add_column(str(horizon), justify="right")
        for path, row in rows.items():
            table.add_row(escape(path), *(f"{loss:.2f}" for loss in row.values()))
        _console().print(table)


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else 200)  # into a file, rich would fold at 80


def _header(name: str) -> str:
    """Break `test/elbo[bernoulli,S=16]` into short lines."""
    split, _, metric = name.partition("/")
    score, _, tag = metric.partition("[")
    return escape(f"{split}\n{score}\n[{tag}")


def _union(tables: Iterable[Iterable[str]]) -> list[str]:
    """Give every name once; those that some lack come where the longest table has them."""
    longest_first = sorted([list(names) for names in tables], key=len, reverse=True)
    return list(dict.fromkeys(itertools.chain.from_iterable(longest_first)))


def _cell(name: str, entry: dict[str, Any]) -> str:
    return f"{entry['per_step']['mean']:.3f}" if "/ess[" in name else str(_estimate(entry))


def _estimate(entry: dict[str, float]) -> Estimate:
    return Estimate(entry["mean"], entry["standard_error"])


def _difference(difference: Estimate) -> str:
    return f"{difference.mean:+.2f} ± {difference.standard_error:.2f} ({_ratio(difference)})"


def _ratio(difference: Estimate) -> str:
    return f"{difference.mean / difference.standard_error:+.1f}" if difference.standard_error > 0 else "n/a"
