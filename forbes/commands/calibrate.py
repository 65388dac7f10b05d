"""`forbes calibrate`: check whether a trained model's filter is exact for the model's own process."""

from collections.abc import Sequence
from itertools import cycle

import torch
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.calibrate import parser
from forbes.errors import ForbesError
from forbes.evaluation.calibration.ranks import coverage
from forbes.evaluation.calibration.self_calibration import SelfCalibration, self_calibration
from forbes.evaluation.calibration.uniformity import kolmogorov_smirnov, pearson, spread
from forbes.evaluation.runs import TrainedRun, load_runs, run_titles
from forbes.figures.calibration import RankedBelief, calibration
from forbes.figures.style import PALETTE, save_png_and_pdf
from forbes.models import StateSpaceModel
from forbes.seeding import generator

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    runs = load_runs(args.runs)
    found = [_check(run, args.sequences, args.time, args.samples, args.seed) for run in runs]
    _print(runs, found, args.samples)
    beliefs = [
        RankedBelief(title, colour, one.value, one.density)
        for title, colour, one in zip(run_titles(runs), cycle(PALETTE), found, strict=False)
    ]
    figure = calibration(beliefs, args.samples)
    print(*save_png_and_pdf(figure, args.output, "calibration"), sep="\n")


def _check(run: TrainedRun, sequences: int, time: int, samples: int, seed: int) -> SelfCalibration:
    """Check one run, with the actions of the first sequences of its training split."""
    if not isinstance(run.model, StateSpaceModel):
        raise ForbesError(f"{run.path}: a {run.family} model has no state that could be ranked. Name other runs")
    size = run.data.source.size("train")
    if time > run.data.length:
        raise ForbesError(f"--time {time}: the sequences of {run.path} have {run.data.length} steps. Choose fewer")
    if sequences > size:
        raise ForbesError(f"--sequences {sequences}: {run.path} was trained on {size} sequences. Choose fewer")
    action = run.data.sequences("train", torch.arange(sequences), time).action
    try:
        return self_calibration(run.model, action, samples, seed)
    except ForbesError as error:  # e.g. if the training diverged
        raise ForbesError(f"{run.path}: {error}") from error


def _print(runs: Sequence[TrainedRun], found: Sequence[SelfCalibration], samples: int) -> None:
    table = Table(title=f"{len(found[0].density)} states sampled from the model, ranked among {samples} of the belief")
    for header in ("run", "family"):
        table.add_column(header, overflow="fold")
    for header in ("within 90 %", "p, density", "p, TARP", "p, values (smallest of D, times D)", "p, classifier"):
        table.add_column(header, justify="right")
    for run, one in zip(runs, found, strict=True):
        within = coverage(one.density, samples, torch.tensor([0.9])).item()
        each = pearson(one.value, samples)
        values = min(1.0, each.min().item() * len(each))  # Bonferroni
        tarp = kolmogorov_smirnov(spread(one.tarp, samples, generator(0, "spread", 0))).item()
        p_values = (pearson(one.density, samples).item(), tarp, values, one.classifier.p_value)
        table.add_row(escape(run.path), run.family, f"{within:.1%}", *(f"{p:.2g}" for p in p_values))
    console(160).print(table)
