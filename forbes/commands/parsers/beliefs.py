"""The arguments of `forbes beliefs`."""

from typing import get_args

from forbes.choices import Split
from forbes.commands.arguments import ArgumentParser, positive
from forbes.commands.parsers.evaluate import add_output

__all__ = ["parser"]

_DESCRIPTION = """\
Measure how far learned beliefs of a known process are from its exact one.

  forbes fit --config configs/pomdp/mirror_sensor/known_mixture.yaml --run_dir runs/mixture
  forbes beliefs runs/mixture

Per step, mean and standard error over sequences:

  forward_kl        KL(exact || q) in nats: large where q misses a mode
  reverse_kl        KL(q || exact) in nats: large where q has mass that should not be there
  state_nll_regret  log exact(s_t) - log q(s_t) of the true state in nats; its mean is the forward KL
  variance_ratio    tr Var q / tr Var exact: below 1 where q is too certain
  mode_mass_error   half the sum over modes of |q - exact|, where the process can have several
  elbo_gap          (log p(o_1..T) - ELBO) / T in nats, where the process has all densities; a smaller gap is not a
                    better belief

A KL is infinite where one belief has mass and the other has none, as an exact belief of bounded support; such a column
gives the share of sequences in which it is, instead of a mean, and the record has it as "infinite".

Below the runs stands the diagonal Gaussian of the exact belief's mean and variance: by the forward KL, the best of its
family. Where the exact belief is a grid, sums over its cells, elsewhere S samples of both. Writes evaluation.json, and
evaluation.npz with each sequence's numbers, into each run folder, or elsewhere: --output DIR"""


def parser() -> ArgumentParser:
    """Return the parser of `forbes beliefs`."""
    command = ArgumentParser("forbes beliefs", _DESCRIPTION)
    command.add_argument(
        "runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made of a KnownBelief"
    )
    add_output(command)
    command.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    command.add_argument("--sequences", type=positive, default=200, help="the first so many (default: 200)")
    command.add_argument("--samples", type=positive, default=100, help="S of beliefs and ELBO (default: 100)")
    command.add_argument("--seed", type=int, default=0, help="of the samples (default: 0)")
    return command
