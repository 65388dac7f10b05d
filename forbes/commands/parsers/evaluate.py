"""The arguments of `forbes evaluate`."""

import argparse
import sys
from typing import get_args

from forbes.choices import PASSES, SUBSET, Split
from forbes.commands.arguments import ArgumentParser, RunsParser, positive
from forbes.errors import ForbesError

__all__ = ["add_acting_samples", "add_output", "add_score_options", "parser", "require_effect"]


_DESCRIPTION = f"""\
Evaluate trained models by likelihood bounds and proper scores, and compare them on the same sequences.

  forbes evaluate runs/compare/forbes-0 runs/compare/rssm-0
  forbes evaluate runs/compare/forbes-0 --scores elbo pll --sequences 200
  forbes evaluate runs/agent/forbes-0 runs/agent/dreamer-0 --episodes 20
  forbes evaluate pretrained:strokes-forbes pretrained:strokes-rssm --sequences 100
  forbes evaluate pretrained:strokes-forbes --model my_adapter:Model checkpoint=model.pt

Scores are nats per sequence of observations, fully normalised, without free nats, as mean and standard error over
sequences. The KL is the Monte-Carlo estimate for every family. The ELBO alone does not identify a good belief, since
it prefers beliefs that are too certain. So there are several scores:

  elbo       the bound and its parts, with S trajectories, on the whole split
  pll        log p(o_t | o_1..t-1) summed over t, with K particles of the belief: the proper score of the filtering
             belief, estimated with the help of the posterior; also the IWAE bound of the same trajectories
  fivo       the sequential Monte-Carlo bound with K particles, and their effective sample size
  open-loop  log p(rest | beginning), with K futures that start from the belief; together with pll also the
             degradation, the nats that a prediction loses with each step without an observation; for images also PSNR
             and SSIM of the mean of up to 100 futures, by step, next to those of the last observed frame

For data of a known process there is also log_p, the exact log p(o_1..T), which no bound exceeds. A VectorModel has no
bounds: its likelihood is exact, and is reported as pll. A ParticleModel uses its own particles for pll and open-loop.

pll, fivo and open-loop score the first {SUBSET} sequences, as the names of the metrics show. Writes evaluation.json,
and evaluation.npz with the scores of each sequence, to each run folder, and for pretrained:NAME to pretrained-NAME in
the current folder, as for --model. If interrupted, the same command resumes where it stopped.

Agents play the same --episodes without exploration; their score is the return. In these episodes are also measured:
- R² of the rewards predicted from the belief, for the current step and 1, 5 and 15 steps ahead (1 = perfect, 0 = no
  better than the mean reward, e.g. an overfitted model or nearly constant rewards);
- the KL of prior and posterior from the nearest Gaussian (near 0 = a Gaussian would do as well);
- if the exact belief is known, the variance of the reward under the agent's belief divided by that under the exact one
  (near 0 = all belief samples agree).
For several seeds of several agents it also prints the interquartile mean over seeds with a bootstrap interval, and the
probability that a seed of one agent earns more than one of another (arXiv 2108.13264).
Results are saved per agent; an interrupted evaluation starts over.

With --acting-samples 32 an agent takes the mean action (discrete: the most frequent) of 32 belief samples instead of
one, as in the paper. This needs no training. If observations are uninformative, it can raise or lower the return a lot.

Several processes share the sequences out: torchrun --nproc-per-node 2 -m forbes evaluate RUN. The scores are the same.

On digit strokes and one core, elbo takes about 4 minutes per run, pll 5, fivo 3, and open-loop 20, in proportion to
--futures and --sequences. Each score is compared with models without a belief on the same sequences: 1- to 5-grams of
pen moves for strokes, the last frame and the mean frame for images. Runs below one of them are marked."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes evaluate`."""
    runs = "run folder written by `forbes fit`, or a checkpoint in it; or pretrained:NAME (`forbes export --help`)"
    command = RunsParser("forbes evaluate", _DESCRIPTION, runs)
    command.add_argument(
        "--checkpoint", metavar="NAME", help="checkpoint in checkpoints/ of every RUN (default: last.ckpt)"
    )
    add_output(command)
    command.add_argument("--episodes", type=positive, default=10, help="number of episodes per agent (default: 10)")
    add_acting_samples(command)
    add_score_options(command)
    return command


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the option for the folder of the results."""
    parser.add_argument("--output", metavar="DIR", help="write results to DIR/NAME-OF-RUN instead")


def add_acting_samples(parser: argparse.ArgumentParser) -> None:
    """Add the option for the number of belief samples that an agent acts on."""
    parser.add_argument(
        "--acting-samples",
        type=positive,
        metavar="K",
        help="number of belief samples whose mean action an agent takes (default: as trained, 1 in the paper)",
    )


def add_score_options(parser: argparse._ActionsContainer) -> None:
    """Add the options of the scores."""
    parser.add_argument("--scores", nargs="+", choices=PASSES, default=PASSES, help="scores to compute (default: all)")
    parser.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    parser.add_argument(
        *("--sequences", "--digits"),
        type=_all_or_number,
        default=None,
        help=f"all, or the number of sequences for every score (default: all for elbo, {SUBSET} for the others)",
    )
    parser.add_argument("--samples", type=positive, default=16, help="trajectories of the ELBO, S (default: 16)")
    parser.add_argument(
        "--particles", type=positive, default=128, help="particles of PLL, IWAE and FIVO, K (default: 128)"
    )
    parser.add_argument(
        "--futures", type=positive, default=1000, help="futures of the open-loop score, K (default: 1000)"
    )
    parser.add_argument(
        "--context", type=positive, default=15, help="steps that the model sees in the open-loop score (default: 15)"
    )
    parser.add_argument("--batch-size", type=positive, default=250, help="sequences per batch (default: 250)")
    parser.add_argument("--seed", type=int, default=0, help="random seed for the noise (default: 0)")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 … (default: auto)")


def _all_or_number(text: str) -> int:
    return sys.maxsize if text == "all" else positive(text)


def require_effect(args: argparse.Namespace, agents: bool) -> None:
    """Refuse options that would have no effect: those of scores for agents, and those of episodes for world models.

    Args:
        args: parsed options.
        agents: whether the runs are those of agents.

    Raises:
        ForbesError: for the first such option.
    """
    if args.checkpoint is not None and not args.runs:
        raise ForbesError("--checkpoint: is of a run, and none is named. Name the file as an argument of the --model")
    of_scores = ("scores", "split", "sequences", "samples", "particles", "futures", "context", "batch_size", "data")
    for name in of_scores if agents else ("episodes", "acting_samples"):
        if getattr(args, name) != parser().get_default(name):
            kind = "world models" if agents else "agents"
            raise ForbesError(f"--{name.replace('_', '-')}: is for {kind}, and none is named. Leave it out")
