"""The arguments of `forbes beliefs`."""

from typing import get_args

from forbes.choices import Split
from forbes.commands.arguments import ArgumentParser, existing_run, positive
from forbes.commands.parsers.evaluate import add_output

__all__ = ["parser"]

_DESCRIPTION = """\
Compare learned beliefs of a known process with the exact ones.

  forbes fit pomdp/mirror_sensor/known_mixture --run_dir runs/mixture
  forbes beliefs runs/mixture

Prints per step, mean and standard error over sequences:

  forward_kl        KL(exact || q) in nats: large if q misses a mode
  reverse_kl        KL(q || exact) in nats: large if q has mass where the exact belief has little; on a grid, of q given
                    the grid
  state_nll_regret  log exact(s_t) - log q(s_t) of the true state in nats; its mean is the forward KL
  variance_ratio    tr Var q / tr Var exact: below 1 if q is too certain
  mode_mass_error   half the sum over modes of |q - exact|, if the process can have several modes
  elbo_gap          (log p(o_1..T) - ELBO) / T in nats, if the process has all densities; a smaller gap does not mean
                    a better belief

A KL is infinite if one belief has mass where the other has none, e.g. for an exact belief with bounded support. The
column then shows the percentage of sequences with an infinite KL instead of a mean; the record has it as "infinite".

The last row is the diagonal Gaussian with the exact belief's mean and variance, the best of its family by the forward
KL. Expectations are sums over the cells if the exact belief is a grid, else means over S samples of both beliefs.
Writes evaluation.json, and evaluation.npz with the scores of each sequence, to each run folder, or to --output DIR."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes beliefs`."""
    command = ArgumentParser("forbes beliefs", _DESCRIPTION)
    command.add_argument(
        "runs", nargs="+", metavar="RUN", type=existing_run, help="run folder of a KnownBelief, written by `forbes fit`"
    )
    add_output(command)
    command.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    command.add_argument("--sequences", type=positive, default=200, help="number of sequences (default: 200)")
    command.add_argument(
        "--samples", type=positive, default=100, help="samples of each belief and of the ELBO, S (default: 100)"
    )
    command.add_argument("--seed", type=int, default=0, help="random seed for the samples (default: 0)")
    return command
