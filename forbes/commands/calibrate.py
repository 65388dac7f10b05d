"""`forbes calibrate`: check whether a trained model's filter is exact for the model's own process."""

from collections.abc import Sequence

import torch
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.calibrate import parser
from forbes.evaluation.adapters import load_all
from forbes.evaluation.calibration.ranks import coverage
from forbes.evaluation.calibration.runs import calibrate_run
from forbes.evaluation.calibration.self_calibration import SelfCalibration
from forbes.evaluation.calibration.uniformity import kolmogorov_smirnov, pearson, spread
from forbes.evaluation.runs import TrainedRun, run_titles
from forbes.figures.calibration import RankedBelief, calibration
from forbes.figures.style import method_styles, save_png_and_pdf
from forbes.seeding import generator

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    runs = load_all(args.runs, args.model, args.data, needs=("sample",))
    found = [calibrate_run(run, args.sequences, args.time, args.samples, args.seed, args.particles) for run in runs]
    _print(runs, found, args.samples)
    styles = method_styles(run_titles(runs))
    beliefs = [
        RankedBelief(title, style, one.value, one.density)
        for (title, style), one in zip(styles.items(), found, strict=True)
    ]
    figure = calibration(beliefs, args.samples)
    print(*save_png_and_pdf(figure, args.output, "calibration"), sep="\n")


def _print(runs: Sequence[TrainedRun], found: Sequence[SelfCalibration], samples: int) -> None:
    table = Table(title=f"{len(found[0].tarp)} states sampled from the model, ranked among {samples} of the belief")
    for header in ("run", "family"):
        table.add_column(header, overflow="fold")
    for header in ("within 90 %", "p, density", "p, TARP", "p, values (smallest of D, times D)", "p, classifier"):
        table.add_column(header, justify="right")
    for run, one in zip(runs, found, strict=True):
        within, density = "n/a", "n/a"
        if one.density is not None:
            within = f"{coverage(one.density, samples, torch.tensor([0.9])).item():.1%}"
            density = f"{pearson(one.density, samples).item():.2g}"
        each = pearson(one.value, samples)
        values = min(1.0, each.min().item() * len(each))  # Bonferroni
        tarp = kolmogorov_smirnov(spread(one.tarp, samples, generator(0, "spread", 0))).item()
        p_values = (tarp, values, one.classifier.p_value)
        table.add_row(escape(run.path), run.family, within, density, *(f"{p:.2g}" for p in p_values))
    console(160).print(table)
