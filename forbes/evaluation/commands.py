"""`forbes evaluate`: bounds and proper scores of trained models, and the paired difference of each two."""

import argparse
import itertools
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, get_args

from torch import Tensor

from forbes.arguments import ArgumentParser, positive
from forbes.data import Simulated, Split
from forbes.errors import ForbesError
from forbes.evaluation.agents import add_acting_samples, evaluate_agents, is_agent
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.measured import SCORES, Measured, note, pair
from forbes.evaluation.progress import with_progress
from forbes.evaluation.record import describe, read_record, write_record
from forbes.evaluation.references import references
from forbes.evaluation.runs import (
    TrainedRun,
    data_name,
    data_sha256,
    find_device,
    load_runs,
    require_comparable,
    split_batches,
)
from forbes.evaluation.scoring import PASSES, Parts, Pass, exact_pass, make_pass, score_split
from forbes.evaluation.tables import print_degradation, print_pairs, print_references, print_runs
from forbes.training.provenance import command_line, commit
from forbes.training.run_folder import RunFolder

__all__ = ["add_score_options", "evaluate", "main", "wanted_metrics"]

_SUBSET = 1000  # sequences that particles are spent on, unless --digits says otherwise

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
             belief; and the IWAE bound, by the same trajectories
  fivo       the sequential Monte-Carlo bound, by K particles, and their effective sample size
  open-loop  log p(rest | beginning), by K futures that start in the belief; with pll, the degradation: how much a
             prediction loses with each step that it has not seen

Data of a known process add log_p, the exact log p(o_1..T), which no bound exceeds. A VectorModel has no bounds, since
its likelihood is exact, and pll gives it; pll and open-loop of a ParticleModel are those of its own sets of particles.

pll, fivo and open-loop take the first {_SUBSET} sequences, and their names say so. Writes evaluation.json, and
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


class _Job(NamedTuple):
    """A pass over the first so many sequences of a split."""

    name: str
    score: Pass
    sequences: int
    sha256: list[str]
    """Of the sequences, as each run's data give them."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = _parser().parse_args(argv)
    command = command_line("evaluate", *argv)
    if is_agent(args.runs[0]):
        return evaluate_agents(
            args.runs, args.episodes, args.acting_samples, args.seed, find_device(args.device), command
        )
    measured = evaluate(args.runs, args, command)
    print_runs(measured)
    print_references(measured)
    if len(measured) > 1:
        print_pairs(pair(measured))
    print_degradation(measured)


def evaluate(paths: Sequence[str], args: Any, command: str) -> list[Measured]:
    """Measure runs on the same sequences and record it in their folders.

    Args:
        paths: run folders.
        args: with the options of `add_score_options`.
        command: for the record.
    """
    runs = load_runs(paths, find_device(args.device))
    jobs = _jobs(args, runs)
    for run in runs:
        read_record(run.path)  # a broken one is said before minutes are spent
    finished: list[Parts] = []
    measured = []
    for number, run in enumerate(runs):
        one = Measured(run, {}, {})
        for job in _of(run, jobs):
            finished.append(_measure(one, job, job.sha256[number], args))
        _add_references(one, jobs, args.split)
        for entry in one.entries.values():
            date = datetime.now(UTC).isoformat(timespec="seconds")
            entry.update(command=command, commit=commit(), seed=args.seed, date=date, parameters=run.parameters)
        measured.append(one)
    for first, second, differences in pair(measured):
        note(first, second, differences)
    for one in measured:
        write_record(one.run.path, one.entries, one.totals)
    for parts in finished:
        parts.remove()
    return measured


def _add_references(one: Measured, jobs: Sequence[_Job], split: Split) -> None:
    """Put beside each score what references have on the same steps of the same sequences."""
    found: dict[int, dict[str, Tensor]] = {}
    for job in _of(one.run, jobs):
        scores = [metric for metric in job.score.metrics if metric in SCORES]
        if scores and job.sequences not in found:
            found[job.sequences] = references(one.run.data, one.run.model.likelihood, split, job.sequences)
        for metric in scores:
            one.entries[_metric_name(one.run, job, metric, split)]["references"] = {
                name: Estimate.of(values[:, job.score.context :].sum(1))._asdict()
                for name, values in found[job.sequences].items()
            }


def wanted_metrics(runs: Sequence[TrainedRun], args: Any) -> list[dict[str, bool]]:
    """Name the metrics that `evaluate` measures runs by, and tell for each run whether its model has them."""
    jobs = _jobs(args, runs)
    return [
        {
            _metric_name(run, job, metric, args.split): metric in job.score.of(run.model).metrics
            for job in jobs
            for metric in job.score.metrics
        }
        for run in runs
    ]


def _parser() -> ArgumentParser:
    parser = ArgumentParser("forbes evaluate", _DESCRIPTION)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made")
    parser.add_argument("--episodes", type=positive, default=10, help="that an agent plays (default: 10)")
    add_acting_samples(parser)
    add_score_options(parser)
    return parser


def add_score_options(parser: argparse._ActionsContainer) -> None:
    """Add what says how runs are measured."""
    parser.add_argument("--scores", nargs="+", choices=PASSES, default=PASSES, help="default: all")
    parser.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    parser.add_argument(
        *("--sequences", "--digits"),
        type=_all_or_number,
        default=None,
        help=f"all, or only the first so many, for every score (default: all for elbo, {_SUBSET} for the others)",
    )
    parser.add_argument("--samples", type=positive, default=16, help="S of the ELBO (default: 16)")
    parser.add_argument("--particles", type=positive, default=128, help="K of PLL, IWAE and FIVO (default: 128)")
    parser.add_argument("--futures", type=positive, default=1000, help="K of the open-loop score (default: 1000)")
    parser.add_argument("--context", type=positive, default=15, help="steps seen by the open-loop score (default: 15)")
    parser.add_argument("--batch-size", type=positive, default=250, help="sequences at a time (default: 250)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda, cuda:1 …")


def _all_or_number(text: str) -> int:
    return sys.maxsize if text == "all" else positive(text)


def _jobs(args: Any, runs: Sequence[TrainedRun]) -> list[_Job]:
    """Say which passes to make, on how many sequences; refuse runs that cannot be compared there."""
    numbers = {"elbo": args.samples, "pll": args.particles, "fivo": args.particles, "open-loop": args.futures}
    wanted = {
        name: make_pass(name, numbers[name], args.batch_size, args.context) for name in PASSES if name in args.scores
    }
    if not any(score.of(run.model).metrics for run in runs for score in wanted.values()):
        raise ForbesError(
            f"{runs[0].path}: a {runs[0].family} model has no {' or '.join(wanted)} score, its likelihood is exact. "
            "Ask for --scores pll or open-loop"
        )
    for run, name in itertools.product(runs, [name for name in ("pll", "open-loop") if name in wanted]):
        run.model.draws(numbers[name])  # a number that cannot be is said before minutes are spent
    if isinstance(source := runs[0].data.source, Simulated):
        wanted = {"exact": exact_pass(source.process)} | wanted
    hashes: dict[int, list[str]] = {}
    jobs = []
    for name, score in wanted.items():
        count = _count(runs[0], args, sys.maxsize if name in ("exact", "elbo") else _SUBSET)
        if count not in hashes:
            for run in runs:
                _count(run, args, count)
            hashes[count] = [data_sha256(run.data, args.split, count) for run in runs]
            require_comparable(runs, hashes[count])
        jobs.append(_Job(name, score, count, hashes[count]))
        if name == "open-loop":
            _require_longer(runs[0], args, count)
    return jobs


def _require_longer(run: TrainedRun, args: Any, count: int) -> None:
    """Refuse sequences that end within the context: nothing of them would be left to score."""
    for first, batch in split_batches(run.data, args.split, count, batch_size=500):
        length = batch.mask.sum(1)  # (B,)
        if (length <= args.context).any():
            place = int(length.argmin())
            raise ForbesError(
                f"--context {args.context}: sequence {first + place} of the {args.split} split of {run.path} has "
                f"{length[place]} steps, expected more. Choose a smaller context, or name other --scores"
            )


def _of(run: TrainedRun, jobs: Sequence[_Job]) -> list[_Job]:
    """Leave out the scores that the run's model does not have."""
    each = [job._replace(score=job.score.of(run.model)) for job in jobs]
    return [job for job in each if job.score.metrics]


def _count(run: TrainedRun, args: Any, default: int) -> int:
    """Give the number of sequences to score."""
    size = run.data.source.size(args.split)
    wanted = min(default, size) if args.sequences is None else args.sequences
    if sys.maxsize > wanted > size:
        raise ForbesError(
            f"--sequences {wanted}: the {args.split} split of {run.path} has {size} sequences. Choose fewer"
        )
    if (count := min(wanted, size)) < 2:
        where = f"the {args.split} split of {run.path}" if size < 2 else f"--sequences {count}"
        raise ForbesError(f"{where}: a standard error needs at least 2 sequences, found {count}. Choose more")
    return count


def _metric_name(run: TrainedRun, job: _Job, metric: str, split: str) -> str:
    """Name a metric in full: `test[:1000]/pll[bernoulli,K=128]`."""
    whole = job.sequences == run.data.source.size(split)  # type: ignore[arg-type]  # argparse has checked it
    part = "" if whole else f"[:{job.sequences}]"
    tag = job.score.tag if job.name == "exact" else f"{run.model.likelihood.name},{job.score.tag}"
    return f"{split}{part}/{metric}[{tag}]"


def _measure(one: Measured, job: _Job, sha256: str, args: Any) -> Parts:
    """Make a pass for a run and add what it finds; give the parts it has left, to be removed in the end."""
    run, score = one.run, job.score
    checkpoint = RunFolder(run.path).checkpoint_sha256()
    parts = Parts(
        Path(run.path) / "evaluation-parts", checkpoint, sha256, job.name, score.tag, score.batch_size, args.seed
    )
    began = time.monotonic()
    batches = split_batches(run.data, args.split, job.sequences, score.batch_size)
    batches = with_progress(batches, f"{run.path} {job.name}", job.sequences)
    scores = score_split(run.model, batches, score, args.seed, f"{run.path}, {args.split} split", parts)
    for metric in score.metrics:
        name = _metric_name(run, job, metric, args.split)
        one.totals[name] = scores.total(metric)
        one.entries[name] = describe(scores, metric) | {
            "data": {"name": data_name(run.data), "sha256": sha256},
            "checkpoint": checkpoint,
            "device": str(next(run.model.parameters()).device),
            "seconds": round(time.monotonic() - began, 1),
        }
    return parts
