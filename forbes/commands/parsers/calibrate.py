"""The arguments of `forbes calibrate`."""

from pathlib import Path

from forbes.commands.arguments import RunsParser, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Check the calibration of trained models against themselves, without ground truth.

  forbes calibrate runs/compare/forbes-0 runs/compare/rssm-0 -o figures
  forbes calibrate pretrained:strokes-forbes --particles 32 --samples 19

States and observations are sampled from the model's own prior. The model filters the observations, and the sampled
state is ranked among samples of the belief. If the filter is exact, the ranks are uniform. A small p-value shows that
it is not; if fewer than 90 % of the states lie in the 90 % region, the beliefs are too narrow. This is expected of a
filter trained with the ELBO. Ranks are tested by Pearson's test, TARP's f by the Kolmogorov-Smirnov test, and a
classifier tries to separate sampled states from samples of the beliefs. Prints a table, writes it to calibration.json,
and draws calibration.png and calibration.pdf."""


def parser() -> RunsParser:
    """Return the parser of `forbes calibrate`."""
    command = RunsParser("forbes calibrate", _DESCRIPTION, "run folder written by `forbes fit`")
    command.add_argument(
        "--sequences", type=positive, default=1000, help="sequences sampled from the model, N (default: 1000)"
    )
    command.add_argument("--samples", type=positive, default=99, help="samples of each belief, L (default: 99)")
    command.add_argument(
        "--particles",
        type=positive,
        help="check a belief of K weighted particles, proposed by the posterior (default: the model's own belief)",
    )
    command.add_argument("--time", type=positive, default=15, help="step whose belief is checked (default: 15)")
    command.add_argument("--seed", type=int, default=0, help="random seed for all samples (default: 0)")
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="output folder (default: figures)")
    return command
