"""The arguments of `forbes calibrate`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive

__all__ = ["parser"]

_DESCRIPTION = """\
Check the calibration of trained models against themselves, without ground truth.

  forbes calibrate runs/compare/forbes-0 runs/compare/rssm-0 -o figures

States and observations are drawn from the model's own prior; the filter sees the observations, and the drawn state is
ranked among samples of its belief. Ranks are uniform where the filter is exact. A small p-value says that it is not;
that fewer than 90 % of the states lie in the 90 % region says that its beliefs are too narrow. A filter trained by the
ELBO is expected to be so. Ranks are tested by Pearson, TARP's f by Kolmogorov and Smirnov, and a classifier tries to
tell drawn states from samples of the beliefs. Prints a table, and draws calibration.png and calibration.pdf."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes calibrate`."""
    command = ArgumentParser("forbes calibrate", _DESCRIPTION)
    command.add_argument("runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made")
    command.add_argument("--sequences", type=positive, default=1000, help="N, drawn from the model (default: 1000)")
    command.add_argument("--samples", type=positive, default=99, help="L, of each belief (default: 99)")
    command.add_argument("--time", type=positive, default=15, help="step whose belief is checked (default: 15)")
    command.add_argument("--seed", type=int, default=0, help="of all that is drawn (default: 0)")
    command.add_argument("-o", "--output", type=Path, default=Path("figures"), help="folder (default: figures)")
    return command
