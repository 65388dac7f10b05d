"""The arguments of `forbes theorem`."""

import argparse
import math

from forbes.commands.arguments import ArgumentParser, positive

__all__ = ["parser"]

_STEPS = 200  # keeps powers of F in the range of float64, and the matrices in memory

_DESCRIPTION = """\
Check Theorem 1 in closed form, and show that a higher ELBO does not mean a better belief.

  forbes theorem
  forbes theorem --transition 0.9 --process-noise 0.3 --observation-noise 0.5 --steps 30

The process is s_1 ~ N(0, 1), s_t = F s_t-1 + N(0, Q), o_t = s_t + N(0, R). Without F, Q and R, three processes are
used. All values are means over observations of the process, in closed form except in the column Monte Carlo.
log p - ELBO and log p - PLL are 0 at best; PLL, the prequential log-likelihood, scores each belief by the next
observation."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes theorem`."""
    command = ArgumentParser("forbes theorem", _DESCRIPTION)
    command.add_argument(
        "--transition", type=_finite, metavar="F", help="with 0 all four beliefs are exact (default: 1)"
    )
    command.add_argument("--process-noise", type=_variance, metavar="Q", help="variance of the process (default: 1)")
    command.add_argument(
        "--observation-noise", type=_variance, metavar="R", help="variance of the observations (default: 1)"
    )
    command.add_argument(
        "--steps", type=_steps, default=15, metavar="T", help=f"number of steps, at most {_STEPS} (default: 15)"
    )
    command.add_argument(
        "--samples", type=_several, default=20_000, metavar="N", help="Monte-Carlo samples (default: 20000)"
    )
    command.add_argument("--seed", type=int, default=0, help="random seed for the samples (default: 0)")
    return command


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a number")
    return value


def _variance(text: str) -> float:
    if (value := _finite(text)) <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not a variance above 0")
    return value


def _steps(text: str) -> int:
    if (value := positive(text)) > _STEPS:
        raise argparse.ArgumentTypeError(f"{text} is above {_STEPS}")
    return value


def _several(text: str) -> int:
    if (value := positive(text)) < 2:
        raise argparse.ArgumentTypeError(f"{text} is below 2, a standard error needs two")
    return value
