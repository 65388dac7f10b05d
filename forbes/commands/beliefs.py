"""`forbes beliefs`: compare learned beliefs of a known process with the exact ones."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from forbes.commands.console import console
from forbes.commands.parsers.beliefs import parser
from forbes.data import SequenceBatch, SequenceDataModule
from forbes.errors import ForbesError
from forbes.evaluation.belief_errors import ERRORS, Belief, belief_errors, mode_centres, moment_matched
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.record import describe, require_readable, results_folders, write_record
from forbes.evaluation.runs import data_name, data_sha256, split_batches
from forbes.evaluation.scores import Increments
from forbes.evaluation.scoring import Scores, require_finite, with_progress
from forbes.pomdps import ExactFilter
from forbes.runs.provenance import command_line, origin
from forbes.seeding import derive_seed, forked, generator
from forbes.training import KnownBelief
from forbes.training.known_belief import has_transition_density
from forbes.training.loading import load_known_belief

__all__ = ["main"]

_ROWS = 10  # sequences per batch: half a million cells on a fine grid


class _Run(NamedTuple):
    """A learned belief, in float64 as the exact one, and its data."""

    path: str
    module: KnownBelief
    data: SequenceDataModule
    checkpoint: str
    """SHA-256 of the checkpoint that the module was loaded from."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    folders = results_folders(args.runs, args.output)
    require_readable(folders.values())
    runs = [_load(path) for path in args.runs]
    sha256 = _same_data(runs, args)
    table = _table(args)
    for run in runs:
        began = time.monotonic()
        scores = _learned(run, args)
        about = origin(command_line("beliefs", *argv), args.seed) | {
            "data": {"name": data_name(run.data), "sha256": sha256},
            "checkpoint": run.checkpoint,
            "seconds": round(time.monotonic() - began, 1),
        }
        names = {metric: _metric_name(run, args, metric) for metric in scores.values}
        entries = {name: _describe(scores, metric) | about for metric, name in names.items()}
        write_record(folders[run.path], entries, {name: scores.values[metric].sum(1) for metric, name in names.items()})
        table.add_row(*_row(run.path, f"{type(run.module.model.head).__name__}, {run.module.objective}", scores))
    table.add_row(*_row("", "moment-matched Gaussian", _matched(runs[0], args)))
    console(200).print(table)


def _load(path: str) -> _Run:
    module, data, _, checkpoint = load_known_belief(path)
    module.require_data(data)
    return _Run(path, module.double(), data, checkpoint)


def _same_data(runs: Sequence[_Run], args: Any) -> str:
    """Return the hash of the sequences; refuse runs with other data or too few sequences."""
    hashes = []
    for run in runs:
        size = run.data.source.size(args.split)
        if not 2 <= args.sequences <= size:
            raise ForbesError(
                f"--sequences {args.sequences}: the {args.split} split of {run.path} has {size}, expected 2 to {size}"
            )
        hashes.append(data_sha256(run.data, args.split, args.sequences))
        if hashes[-1] != hashes[0]:
            raise ForbesError(
                f"{run.path}: its data are {data_name(run.data)}, those of {runs[0].path} are "
                f"{data_name(runs[0].data)}, expected the same sequences. Compare runs of the same data"
            )
    return hashes[0]


def _score(run: _Run, args: Any, name: str, compare: Callable[[int, SequenceBatch, ExactFilter], Increments]) -> Scores:
    """Compare beliefs with the exact ones, batch by batch, all in float64."""
    parts, masks = [], []
    batches = split_batches(run.data, args.split, args.sequences, _ROWS)
    for first, batch in with_progress(batches, f"{run.path} {name}", args.sequences):
        observation, action, state = batch.observation.double(), batch.action.double(), batch.state.double()
        exact = run.module.process.exact_filter(observation, action)
        batch = batch._replace(observation=observation, action=action, state=state)
        with forked("cpu", derive_seed(args.seed, "beliefs", first)), torch.no_grad():
            parts.append(compare(first, batch, exact))
        masks.append(batch.mask)
    return Scores({name: torch.cat([part[name] for part in parts]) for name in parts[0]}, torch.cat(masks))


def _compare(run: _Run, args: Any, first: int, batch: SequenceBatch, exact: ExactFilter, belief: Belief) -> Increments:
    draw = generator(args.seed, "beliefs", first)
    return belief_errors(exact.belief, belief, batch.state, mode_centres(run.module.process), args.samples, draw)


def _learned(run: _Run, args: Any) -> Scores:
    """Return the errors of a run's learned beliefs."""
    model, has_elbo = run.module.model, has_transition_density(run.module.process)

    def compare(first: int, batch: SequenceBatch, exact: ExactFilter) -> Increments:
        errors = _compare(run, args, first, batch, exact, model.belief(batch.observation, batch.action))
        if has_elbo:
            paths = [model.elbo(batch.observation, batch.action, batch.mask) for _ in range(args.samples)]
            bound = sum((path.reconstruction - path.kl for path in paths), start=torch.zeros(())) / args.samples
            errors["elbo_gap"] = exact.step_log_likelihood - bound  # (B, T)
        return errors

    scores = _score(run, args, "learned", compare)
    require_finite(
        run.path, 0, {name: values.where(values != torch.inf, 0.0) for name, values in scores.values.items()}
    )
    return scores


def _matched(run: _Run, args: Any) -> Scores:
    """Return the errors of the Gaussian with the exact belief's mean and variance."""

    def compare(first: int, batch: SequenceBatch, exact: ExactFilter) -> Increments:
        return _compare(run, args, first, batch, exact, moment_matched(exact.belief))

    return _score(run, args, "moment-matched", compare)


def _metric_name(run: _Run, args: Any, metric: str) -> str:
    """Return the full name of a metric, e.g. `test[:200]/forward_kl[S=100]`."""
    whole = args.sequences == run.data.source.size(args.split)
    return f"{args.split}{'' if whole else f'[:{args.sequences}]'}/{metric}[S={args.samples}]"


def _table(args: Any) -> Table:
    table = Table(
        title=f"errors against the exact belief, per step, mean ± standard error over {args.sequences} sequences"
    )
    for header in ("run", "belief"):
        table.add_column(header, overflow="fold")
    for metric in (*ERRORS, "elbo_gap"):
        table.add_column(metric, justify="right", no_wrap=True)
    return table


def _row(name: str, belief: str, scores: Scores) -> list[str]:
    """Return a row of the table, with empty cells for metrics that the process or belief does not have."""
    cells = []
    for metric in (*ERRORS, "elbo_gap"):
        values = scores.values.get(metric)
        cells.append("" if values is None else _cell(values.sum(1), scores.steps))
    return [escape(name), belief, *cells]


def _cell(totals: Tensor, steps: Tensor) -> str:
    """Return the mean over all steps, or the fraction of sequences in which it is infinite, as text."""
    if fraction := _fraction_infinite(totals):
        return f"inf in {fraction:.1%}"
    per_step = Estimate.per_step(totals, steps)
    return f"{per_step.mean:.3f} ± {per_step.standard_error:.3f}"


def _describe(scores: Scores, metric: str) -> dict[str, Any]:
    """Return the entry of `evaluation.json`. JSON has no infinity, so an infinite mean is null."""
    fraction = _fraction_infinite(scores.total(metric))
    if fraction == 0:
        return describe(scores, metric) | {"infinite": fraction}
    unknown = {"mean": None, "standard_error": None}
    counts = {"sequences": len(scores.mask), "steps": int(scores.steps.sum())}
    return {**unknown, "per_step": unknown, **counts, "infinite": fraction}


def _fraction_infinite(totals: Tensor) -> float:
    """Return the fraction of sequences with an infinite score, `(N,)`."""
    return totals.isinf().double().mean().item()
