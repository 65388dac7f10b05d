"""The arguments of `forbes evaluate`."""

import argparse
import sys
from typing import get_args

from forbes.choices import PASSES, SUBSET, Split
from forbes.commands.arguments import ArgumentParser, positive

__all__ = ["add_acting_samples", "add_output", "add_score_options", "parser"]


_DESCRIPTION = f"""\
Measure trained models by bounds and proper scores, and compare them on the same sequences.

  forbes evaluate runs/compare/forbes-0 runs/compare/rssm-0
  forbes evaluate runs/compare/forbes-0 --scores elbo pll --sequences 200
  forbes evaluate runs/agent/forbes-0 runs/agent/dreamer-0 --episodes 20

Nats per sequence of observations, fully normalised, without free nats; the KL is the Monte-Carlo estimate for every
family; mean and standard error over sequences. An ELBO alone does not tell a good belief: it prefers one that is too
certain. So beside it:

  elbo       the bound and its parts, S trajectories, on the whole split
  pll        log p(o_t | o_1..t-1) summed over t, by K particles of the belief: the proper score of the filtering
             belief. The posterior helps to estimate it, without bias. And the IWAE bound, by the same trajectories
  fivo       the sequential Monte-Carlo bound, by K particles, and their effective sample size
  open-loop  log p(rest | beginning), by K futures that start in the belief; with pll, the degradation: how much a
             prediction loses with each step that it has not seen

Data of a known process add log_p, the exact log p(o_1..T), which no bound exceeds. A VectorModel has no bounds, since
its likelihood is exact, and pll gives it; pll and open-loop of a ParticleModel are those of its own sets of particles.

pll, fivo and open-loop take the first {SUBSET} sequences, and their names say so. Writes evaluation.json, and
evaluation.npz with each sequence's scores, into each run folder. Interrupted, the same command goes on where it
stopped.

Agents play --episodes without exploration, the same ones for all, whatever each is shown; their score is the return.
Beside it stands what share of the rewards' variance in these episodes the world model foretells, from its belief and 1,
5 and 15 steps ahead by the actions taken: 1 is perfect, 0 no better than the mean reward, as of a model that knows its
own episodes by heart, or where rewards hardly vary; then how far prior and posterior are from the nearest Gaussian, 0
where the family makes no difference; and, of a process whose exact belief is known, how unsure the agent's belief is of
the reward, as a share of the exact one's variance: near 0 where its draws all say the same. All is kept as each agent
ends; interrupted, all play again.

With --acting-samples 32 an agent takes the mean action of 32 trajectories of its belief (of discrete actions the
commonest), not that of one, which is the paper's: no training is needed for it, and where an observation tells little
it can be worth much, or cost as much.

On digit strokes and one core, elbo takes some 4 minutes a run, pll 5, fivo 3, and open-loop 20, in proportion to
--futures and --sequences. Beside each score stands what models without a belief have on the same sequences, of
strokes 1- to 5-grams of pen moves, of images the last frame and the mean frame; a run below one of them is marked."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes evaluate`."""
    command = ArgumentParser("forbes evaluate", _DESCRIPTION)
    command.add_argument(
        "runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made, or a checkpoint in it"
    )
    command.add_argument("--checkpoint", metavar="NAME", help="another than last.ckpt, in checkpoints/ of every RUN")
    add_output(command)
    command.add_argument("--episodes", type=positive, default=10, help="that an agent plays (default: 10)")
    add_acting_samples(command)
    add_score_options(command)
    return command


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add what says where results go."""
    parser.add_argument("--output", metavar="DIR", help="results go to DIR/NAME-OF-RUN, not into the run folders")


def add_acting_samples(parser: argparse.ArgumentParser) -> None:
    """Add what says how an agent acts on its belief."""
    parser.add_argument(
        "--acting-samples",
        type=positive,
        metavar="K",
        help="trajectories of its belief whose mean action an agent takes (default: as it was trained, 1 in the paper)",
    )


def add_score_options(parser: argparse._ActionsContainer) -> None:
    """Add what says how runs are measured."""
    parser.add_argument("--scores", nargs="+", choices=PASSES, default=PASSES, help="default: all")
    parser.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    parser.add_argument(
        *("--sequences", "--digits"),
        type=_all_or_number,
        default=None,
        help=f"all, or only the first so many, for every score (default: all for elbo, {SUBSET} for the others)",
    )
    parser.add_argument("--samples", type=positive, default=16, help="S of the ELBO (default: 16)")
    parser.add_argument("--particles", type=positive, default=128, help="K of PLL, IWAE and FIVO (default: 128)")
    parser.add_argument("--futures", type=positive, default=1000, help="K of the open-loop score (default: 1000)")
    parser.add_argument("--context", type=positive, default=15, help="steps seen by the open-loop score (default: 15)")
    parser.add_argument("--batch-size", type=positive, default=250, help="sequences at a time (default: 250)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 … (default: auto)")


def _all_or_number(text: str) -> int:
    return sys.maxsize if text == "all" else positive(text)
