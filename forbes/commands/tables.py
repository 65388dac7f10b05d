"""The tables of `forbes evaluate`: one row per score, one column per run."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.metrics import EvaluatedRun, Pair, at_horizons, degradation, score_of
from forbes.evaluation.references import best_reference, lowest_above, merge_equal

__all__ = ["beaten_by", "print_degradation", "print_images", "print_pairs", "print_references"]
__all__ += ["print_runs"]


def print_runs(measured: Sequence[EvaluatedRun]) -> None:
    """Print every metric of every run; n/a if its model does not have it."""
    screen = console(200)
    for number, evaluated in enumerate(measured, start=1):
        text = (
            f"{number}  {escape(evaluated.run.path)}: {evaluated.run.family}, {evaluated.run.parameters:,} parameters"
        )
        screen.print(text, soft_wrap=True)
    columns = {
        str(number): {name: _cell(name, entry) for name, entry in evaluated.entries.items()}
        for number, evaluated in enumerate(measured, start=1)
    }
    _print(screen, "nats per sequence, mean ± standard error; ess as a fraction of K", columns)


def print_references(measured: Sequence[EvaluatedRun]) -> None:
    """Print the scores of the references on the same sequences, explain the marks of `print_runs`, and compare."""
    rows = {
        name: {reference: str(_estimate(estimate)) for reference, estimate in entry["references"].items()}
        for name, entry in itertools.chain.from_iterable(evaluated.entries.items() for evaluated in measured)
        if entry.get("references")
    }
    if not rows:
        return
    columns: dict[str, dict[str, str]] = {}
    for names, row in merge_equal(rows).items():
        for reference, cell in row.items():
            columns.setdefault(reference, {})[names] = cell
    screen = console(200)
    _print(screen, "log p of the same steps under models without a belief, nats per sequence", columns)
    below = {
        evaluated.run.path: [score_of(name) for name, entry in evaluated.entries.items() if beaten_by(entry)]
        for evaluated in measured
    }
    if named := ", ".join(f"{path} ({', '.join(scores)})" for path, scores in below.items() if scores):
        text = f"<: below this reference: {named}. A model whose tightest score is below one has learned less than it."
        screen.print(escape(text), soft_wrap=True)
    differences = {
        str(number): {name: over for name, entry in evaluated.entries.items() if (over := _over_best(entry))}
        for number, evaluated in enumerate(measured, start=1)
    }
    _print(screen, "paired differences to the best of these, nats per sequence", differences)


def _over_best(entry: Mapping[str, Any]) -> str:
    """Return the difference of a score to its best reference, with its name; nothing if it has none."""
    if (best := best_reference(entry)) is None:
        return ""
    return f"{_signed(_estimate(entry['references'][best]['difference']))}\n({best})"


def beaten_by(entry: Mapping[str, Any]) -> str | None:
    """Return the lowest reference above an entry of `evaluation.json`, or None if there is none above it."""
    return lowest_above(entry["mean"], {name: each["mean"] for name, each in entry.get("references", {}).items()})


def print_pairs(pairs: Sequence[Pair]) -> None:
    """Print the paired difference of every metric in `SCORES`; n/a if a model does not have it."""
    runs = list(dict.fromkeys(run.run.path for pair in pairs for run in pair[:2]))
    columns = {
        f"{runs.index(first.run.path) + 1} − {runs.index(second.run.path) + 1}": {
            name: _difference(difference) for name, difference in differences.items()
        }
        for first, second, differences in pairs
    }
    _print(console(200), "paired differences over the same sequences, nats per sequence (in standard errors)", columns)


def print_degradation(measured: Sequence[EvaluatedRun]) -> None:
    """Print the degradation of every run that has both the closed-loop and the open-loop score."""
    curves: dict[str, dict[str, list[float]]] = {}
    for evaluated in measured:
        for name, entry in evaluated.entries.items():
            curves.setdefault(name, {})[evaluated.run.path] = entry["curve"]
    for metric, of_runs in degradation(curves).items():
        rows = at_horizons(metric, of_runs)
        numbers = {evaluated.run.path: str(number) for number, evaluated in enumerate(measured, start=1)}
        columns = {
            numbers[path]: {f"{horizon} steps": f"{loss:.2f}" for horizon, loss in row.items()}
            for path, row in rows.items()
        }
        _print(console(200), f"{metric}: nats that a prediction loses, by steps after the last observation", columns)


def print_images(measured: Sequence[EvaluatedRun]) -> None:
    """Print PSNR and SSIM one step and every five steps after the context, next to those of the last frame."""
    for name, entry in {name: entry for each in reversed(measured) for name, entry in each.images.items()}.items():
        digits, unit = (1, " in dB") if entry["unit"] == "dB" else (3, "")
        shown = [steps for steps in range(1, len(entry["model"]) + 1) if steps == 1 or steps % 5 == 0]
        curves = {str(number): each.images.get(name, {}).get("model") for number, each in enumerate(measured, start=1)}
        columns = {
            header: {f"{steps} steps": _image_score(curve[steps - 1], digits) for steps in shown} if curve else {}
            for header, curve in (curves | {"last frame": entry["last frame"]}).items()
        }
        title = f"{name}: score of the mean prediction as an image{unit}, by steps after the last observation"
        _print(console(200), title, columns)


def _image_score(value: float | None, digits: int) -> str:
    return "exact" if value is None else f"{value:.{digits}f}"


def _print(screen: Console, title: str, columns: Mapping[str, Mapping[str, str]]) -> None:
    """Print a table with named rows; if it is wider than the console, split its columns into several tables."""
    names = [(name, _in_lines(name)) for name in _union(columns.values())]
    room = screen.width - max((len(line) for _, lines in names for line in lines.split("\n")), default=0) - 4
    widths = {
        header: max(len(line) for cell in (header, *cells.values()) for line in cell.split("\n")) + 3
        for header, cells in columns.items()
    }
    screen.print(f"\n{escape(title)}", soft_wrap=True)
    for headers in _fitting(widths, room):
        table = Table()
        table.add_column("score", no_wrap=True)
        for header in headers:
            table.add_column(escape(header), justify="right", no_wrap=True)
        for name, lines in names:
            table.add_row(escape(lines), *(escape(columns[header].get(name, "n/a")) for header in headers))
        screen.print(table)


def _fitting(widths: Mapping[str, int], room: int) -> Iterator[list[str]]:
    """Split columns into groups that fit into the room, with at least one column each."""
    group: list[str] = []
    for header, width in widths.items():
        if group and sum(widths[each] for each in group) + width > room:
            yield group
            group = []
        group.append(header)
    if group:
        yield group


def _in_lines(name: str) -> str:
    """Break a name such as `test[:1000]/pll[categorical,K=128]` into two lines before its tag."""
    split, slash, rest = name.partition("/")
    score, bracket, tag = rest.partition("[")
    return f"{split}{slash}{score}\n  {bracket}{tag}" if bracket else name


def _union(tables: Iterable[Iterable[str]]) -> list[str]:
    """Return every name once, in the order of the longest table."""
    longest_first = sorted([list(names) for names in tables], key=len, reverse=True)
    return list(dict.fromkeys(itertools.chain.from_iterable(longest_first)))


def _cell(name: str, entry: dict[str, Any]) -> str:
    if "/ess[" in name:
        return f"{entry['per_step']['mean']:.3f}"
    reference = beaten_by(entry)
    return f"{_estimate(entry)}" + (f"\n< {reference}" if reference else "")


def _estimate(entry: Mapping[str, float]) -> Estimate:
    return Estimate(entry["mean"], entry["standard_error"])


def _difference(difference: Estimate) -> str:
    return f"{_signed(difference)}\n({_ratio(difference)})"


def _signed(difference: Estimate) -> str:
    return f"{difference.mean:+.2f} ± {difference.standard_error:.2f}"


def _ratio(difference: Estimate) -> str:
    ratio = difference.mean / difference.standard_error if difference.standard_error > 0 else math.nan
    return f"{ratio:+.1f}" if math.isfinite(ratio) else "n/a"
