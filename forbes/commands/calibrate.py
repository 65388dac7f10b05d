"""`forbes calibrate`: check whether a trained model's filter is exact for the model's own process."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.calibrate import parser
from forbes.errors import ForbesError
from forbes.evaluation.adapters import load_all
from forbes.evaluation.calibration.ranks import coverage
from forbes.evaluation.calibration.runs import calibrate_run
from forbes.evaluation.calibration.self_calibration import SelfCalibration
from forbes.evaluation.calibration.uniformity import BINS, kolmogorov_smirnov, pearson, spread
from forbes.evaluation.runs import TrainedRun, run_titles
from forbes.figures.calibration import RankedBelief, calibration
from forbes.figures.style import method_styles, save_png_and_pdf
from forbes.files import replace_file
from forbes.runs.provenance import command_line, origin
from forbes.seeding import generator

__all__ = ["main"]


class _Tests(NamedTuple):
    """What the ranks of a run say of its filter."""

    within_90: float | None
    """Share of the states in the region that should hold 90 % of them; None without a density."""
    p_density: float | None
    p_tarp: float
    p_values: float
    """The smallest p of the D dimensions, times D (Bonferroni)."""
    p_classifier: float


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    for name, least in (("samples", BINS - 1), ("sequences", 5 * BINS)):
        if getattr(args, name) < least:
            raise ForbesError(
                f"--{name} {getattr(args, name)}: expected at least {least}, for a test of ranks in {BINS} bins"
            )
    runs = load_all(args.runs, args.model, args.data, needs=("sample",))
    found = [calibrate_run(run, args.sequences, args.time, args.samples, args.seed, args.particles) for run in runs]
    tests = [_tests(one, args.samples) for one in found]
    _print(runs, tests, args)
    styles = method_styles(run_titles(runs))
    beliefs = [
        RankedBelief(title, style, one.value, one.density)
        for (title, style), one in zip(styles.items(), found, strict=True)
    ]
    figure = calibration(beliefs, args.samples)
    print(_record(runs, tests, args, command_line("calibrate", *argv)))
    print(*save_png_and_pdf(figure, args.output, "calibration"), sep="\n")


def _tests(found: SelfCalibration, samples: int) -> _Tests:
    within, density = None, None
    if found.density is not None:
        within = coverage(found.density, samples, torch.tensor([0.9])).item()
        density = pearson(found.density, samples).item()
    each = pearson(found.value, samples)  # (D,)
    tarp = kolmogorov_smirnov(spread(found.tarp, samples, generator(0, "spread", 0))).item()
    return _Tests(within, density, tarp, min(1.0, each.min().item() * len(each)), found.classifier.p_value)


def _record(runs: Sequence[TrainedRun], tests: Sequence[_Tests], args: Any, command: str) -> Path:
    """Write the tests with what they depend on, and return the file."""
    numbers = {name: getattr(args, name) for name in ("sequences", "samples", "particles", "time")}
    of_runs = [
        {"run": run.path, "family": run.family, "checkpoint": run.checkpoint, **one._asdict()}
        for run, one in zip(runs, tests, strict=True)
    ]
    record = origin(command, args.seed) | numbers | {"runs": of_runs}
    path: Path = args.output / "calibration.json"
    replace_file(path, f"{json.dumps(record, indent=2)}\n".encode())
    return path


def _print(runs: Sequence[TrainedRun], tests: Sequence[_Tests], args: Any) -> None:
    table = Table(title=f"{args.sequences} states sampled from the model, ranked among {args.samples} of the belief")
    for header in ("run", "family"):
        table.add_column(header, overflow="fold")
    for header in ("within 90 %", "p, density", "p, TARP", "p, values (smallest of D, times D)", "p, classifier"):
        table.add_column(header, justify="right")
    for run, (within, *p_values) in zip(runs, tests, strict=True):
        cells = ["n/a" if p is None else f"{p:.2g}" for p in p_values]
        table.add_row(escape(run.path), run.family, "n/a" if within is None else f"{within:.1%}", *cells)
    console(160).print(table)
