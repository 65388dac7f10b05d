"""`forbes evaluate`: the ELBO of trained models on a whole split, and the paired difference of each two."""

import itertools
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple, get_args

import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from forbes.arguments import ArgumentParser, positive
from forbes.data import SequenceBatch, Split
from forbes.errors import ForbesError
from forbes.evaluation.elbo import Bound, Estimate, evaluate_elbo, paired_difference
from forbes.evaluation.record import bound_metrics, read_record, summary, write_record
from forbes.evaluation.runs import TrainedRun, data_name, data_sha256, load_runs, require_comparable, split_batches
from forbes.training.provenance import commit

__all__ = ["main"]

_DESCRIPTION = """\
Measure the ELBO of trained models, and compare them on the same sequences.

  forbes evaluate runs/compare/forbes runs/compare/rssm

Nats per sequence of observations, fully normalised, without free nats; the KL is the Monte-Carlo estimate for every
family; mean and standard error over sequences. Writes evaluation.json, and evaluation.npz with each sequence's value,
into each run folder."""

_ALL_PAIRS = 4  # runs up to which every two are compared; of more, each with the first


class _Evaluation(NamedTuple):
    """One run, measured."""

    run: TrainedRun
    split: str
    """Its name, with the number of sequences where that is not all: `test[:1000]`."""
    bound: Bound
    entry: dict[str, Any]
    """For `evaluation.json`."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = _parser().parse_args(argv)
    runs = load_runs(args.runs, _device(args.device))
    counts = [_count(run, args.split, args.digits) for run in runs]
    hashes = [data_sha256(run.data, args.split, count) for run, count in zip(runs, counts, strict=True)]
    require_comparable(runs, hashes)
    for run in runs:
        read_record(run.path)  # a broken one is said before minutes are spent
    evaluations = []
    for run in runs:
        evaluation = _evaluate(run, args, counts[0])
        evaluation.entry.update(
            data={"name": data_name(run.data), "sha256": hashes[0]},
            command=shlex.join(["forbes", "evaluate", *argv]),
            commit=commit(),
            date=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        evaluations.append(evaluation)
    pairs = _pair(evaluations)
    for evaluation in evaluations:
        write_record(evaluation.run.path, evaluation.split, evaluation.entry, evaluation.bound)
    console = Console(width=None if sys.stdout.isatty() else 160)  # into a file, rich would fold at 80
    _print_runs(evaluations, console)
    if pairs:
        _print_pairs(pairs, console)


def _parser() -> ArgumentParser:
    parser = ArgumentParser("forbes evaluate", _DESCRIPTION)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made")
    parser.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    parser.add_argument("--samples", type=positive, default=16, help="S, trajectories per sequence (default: 16)")
    parser.add_argument("--digits", type=_all_or_number, default=None, help="all (default), or only the first so many")
    parser.add_argument("--batch-size", type=positive, default=250, help="sequences at a time (default: 250)")
    parser.add_argument("--seed", type=int, default=0, help="of the posterior's noise (default: 0)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda, cuda:1 …")
    return parser


def _all_or_number(text: str) -> int | None:
    return None if text == "all" else positive(text)


def _device(name: str) -> str:
    """Choose a device, and try it."""
    chosen = ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
    try:
        torch.zeros(1, dtype=torch.float64, device=chosen)
    # What torch raises for a name it does not know, without CUDA, and where there is no float64.
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ForbesError(f"--device {name}: it cannot be used ({reason}). Choose cpu, or auto") from error
    return chosen


def _count(run: TrainedRun, split: Split, wanted: int | None) -> int:
    size = run.data.source.size(split)
    if wanted is not None and wanted > size:
        raise ForbesError(f"--digits {wanted}: the {split} split of {run.path} has {size} sequences. Choose fewer")
    if (count := wanted or size) < 2:
        raise ForbesError(f"--digits {count}: a standard error needs at least 2 sequences. Choose more")
    return count


def _evaluate(run: TrainedRun, args: Any, sequences: int) -> _Evaluation:
    """Measure one run."""
    split = args.split if sequences == run.data.source.size(args.split) else f"{args.split}[:{sequences}]"
    batches = split_batches(run.data, args.split, sequences, args.batch_size)
    device = next(run.model.parameters()).device
    began = time.monotonic()
    bound = evaluate_elbo(
        run.model,
        _progress(batches, run.path, sequences),
        args.samples,
        args.seed,
        device,
        f"{run.path}, {split} split",
    )
    metrics = bound_metrics(bound, split, run.model.likelihood.name, args.samples)
    entry = {
        "metrics": {name: estimate._asdict() for name, estimate in metrics.items()},
        "elbo_over_sequences": summary(bound),
        "sequences": sequences,
        "steps": int(bound.steps.sum()),
        "samples": args.samples,
        "seed": args.seed,
        "device": str(device),
        "seconds": round(time.monotonic() - began, 1),
    }
    return _Evaluation(run, split, bound, entry)


def _progress(
    batches: Iterator[tuple[int, SequenceBatch]], name: str, sequences: int
) -> Iterator[tuple[int, SequenceBatch]]:
    """Pass batches on, with a bar on a terminal and a line at each tenth elsewhere."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(escape(name), total=sequences)
        tenth = 0
        for first, batch in batches:
            yield first, batch
            bar.advance(task, len(batch.mask))
            done = first + len(batch.mask)
            if bar.disable and 10 * done // sequences > tenth:
                tenth = 10 * done // sequences
                print(f"{name}: {done}/{sequences} sequences", file=sys.stderr, flush=True)


def _pair(evaluations: Sequence[_Evaluation]) -> list[tuple[_Evaluation, _Evaluation, Estimate]]:
    """Compare every two runs, or where there are many each with the first, and note it in both entries."""
    pairs = []
    for first, second in itertools.combinations(evaluations, 2):
        if len(evaluations) > _ALL_PAIRS and first is not evaluations[0]:
            break
        difference = paired_difference(first.bound, second.bound)
        pairs.append((first, second, difference))
        for one, other, sign in [(first, second, 1), (second, first, -1)]:
            paired = {"minus": other.run.path, "elbo": sign * difference.mean}
            one.entry.setdefault("paired", []).append(paired | {"standard_error": difference.standard_error})
    return pairs


def _print_runs(evaluations: Sequence[_Evaluation], console: Console) -> None:
    name = next(iter(evaluations[0].entry["metrics"]))
    table = Table(title=escape(f"{name}, {evaluations[0].entry['sequences']} sequences, in nats"))
    for header in ("run", "family"):
        table.add_column(header, overflow="fold")
    for header in ("parameters", "ELBO per sequence", "per step", "reconstruction", "KL"):
        table.add_column(header, justify="right")
    for run, _, _, entry in evaluations:
        elbo, per_step, reconstruction, kl = (Estimate(**metric) for metric in entry["metrics"].values())
        table.add_row(
            escape(run.path), run.family, f"{run.parameters:,}", f"{elbo.mean:.2f} ± {elbo.standard_error:.2f}",
            f"{per_step.mean:.3f} ± {per_step.standard_error:.3f}", f"{reconstruction.mean:.2f}", f"{kl.mean:.2f}",
        )  # fmt: skip
    console.print(table)


def _print_pairs(pairs: Sequence[tuple[_Evaluation, _Evaluation, Estimate]], console: Console) -> None:
    table = Table(title="paired difference of the ELBO over the same sequences, in nats per sequence")
    for header in ("run", "minus"):
        table.add_column(header, overflow="fold")
    for header in ("difference", "standard errors from 0", "higher on"):
        table.add_column(header, justify="right")
    for first, second, (mean, error) in pairs:
        higher = (first.bound.elbo > second.bound.elbo).double().mean().item()
        ratio = f"{mean / error:+.1f}" if error > 0 else "n/a"
        paths = (escape(evaluation.run.path) for evaluation in (first, second))
        table.add_row(*paths, f"{mean:+.2f} ± {error:.2f}", ratio, f"{higher:.0%}")
    console.print(table)
