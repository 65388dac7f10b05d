"""Score a model on a whole split, batch by batch: memory is bounded, scores are finite, and it can be resumed."""

import hashlib
import io
import itertools
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from torch import Tensor

from forbes.choices import PASSES, SUBSET
from forbes.data import SequenceBatch, SequenceData, Split
from forbes.distributed import num_ranks, of_all_ranks, rank
from forbes.errors import ForbesError, require_at_least
from forbes.evaluation.adapter_checks import check_model
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import split_batches
from forbes.evaluation.scores import Increments, score_open_loop, score_particles, score_predictions, score_trajectories
from forbes.files import replace_file
from forbes.models import BeliefModel, ModelAdapter, PartsLikelihood
from forbes.pomdps import Process
from forbes.reading import read_npz
from forbes.seeding import derive_seed, forked

__all__ = [
    "PartialScores",
    "Scorer",
    "Scores",
    "evaluate",
    "exact_scorer",
    "make_scorer",
    "require_finite",
    "score_split",
    "with_progress",
]


class Scorer(NamedTuple):
    """One pass over the data, which computes one or more scores."""

    metrics: tuple[str, ...]
    """Names of the scores to keep, among those that `function` returns."""
    tag: str
    """Settings such as the number of samples; part of each metric's name."""
    function: Callable[[Any, SequenceBatch], Increments]
    """Compute the scores of a model on a batch."""
    batch_size: int
    """Number of sequences per batch."""
    context: int = 0
    """Number of leading steps that the model observes and that are not scored."""

    def of(self, model: BeliefModel) -> "Scorer":
        """Drop what a model lacks, e.g. the bounds if it has no posterior with a density; add what it has by part."""
        metrics = [metric for metric in self.metrics if metric not in model.lacks]
        if "reconstruction" in metrics and isinstance(model.likelihood, PartsLikelihood):
            metrics += [f"reconstruction/{name}" for name in model.likelihood.parts]
        return self._replace(metrics=tuple(metrics))


class Scores(NamedTuple):
    """Scores of all sequences, in nats, float64 on the CPU."""

    values: Increments
    """Contribution of each step, `(N, T)`, by metric; 0 on padding."""
    mask: Tensor
    """True where a step is scored (neither padding nor context), `(N, T)`."""

    @property
    def steps(self) -> Tensor:
        """Number of scored steps of each sequence, `(N,)`."""
        return self.mask.sum(1)

    def total(self, metric: str) -> Tensor:
        """Return the score of each sequence, `(N,)`: the sum over steps, or the mean for the effective sample size."""
        total = self.values[metric].sum(1)
        return total / self.steps if metric == "ess" else total


_FIVO_ROWS = 16
"""FIVO holds all particles of a sequence at once. It gets this many rows per sequence of another scorer's batch."""


def make_scorer(name: str, number: int, batch_size: int, context: int) -> Scorer:
    """Build a scorer for one of the names accepted by `forbes evaluate --scores`.

    Args:
        name: elbo (with its parts), pll (with the IWAE of the same trajectories), fivo (with its effective sample
            size), or open-loop.
        number: number of samples S (elbo), particles K (pll, fivo) or futures K (open-loop).
        batch_size: number of sequences per batch.
        context: number of steps that the model observes before the open-loop score begins, c.
    """
    if name == "elbo":
        function = partial(score_trajectories, number=number, predict=False)
        return Scorer(("elbo", "reconstruction", "kl"), f"S={number}", function, batch_size)
    if name == "pll":
        return Scorer(("iwae", "pll"), f"K={number}", partial(score_predictions, number=number), batch_size)
    if name == "fivo":
        rows = max(1, _FIVO_ROWS * batch_size // number)
        return Scorer(("fivo", "ess"), f"K={number}", partial(score_particles, number=number), rows)
    metrics, function = ("open_loop", "open_loop_marginal"), partial(score_open_loop, number=number, context=context)
    return Scorer(metrics, f"K={number},c={context}", function, batch_size, context)


def evaluate(
    model: BeliefModel,
    data: SequenceData,
    scores: Sequence[str] = ("elbo", "pll"),
    split: Split = "test",
    sequences: int = SUBSET,
    samples: int = 16,
    particles: int = 128,
    futures: int = 1000,
    context: int = 15,
    batch_size: int = 250,
    seed: int = 0,
) -> dict[str, Estimate]:
    """Score a model, trained or not, on the first sequences of a split, as `forbes evaluate` does for a run.

    Args:
        model: `world.model` of a `WorldModel`. Scores are computed on its device.
        data: data module with the sequences.
        scores: some of elbo, pll, fivo and open-loop. Each adds metrics: elbo its parts, pll the IWAE bound, fivo the
            effective sample size, open-loop the marginals. A `VectorModel` has no bounds.
        split: train, validation or test.
        sequences: number of sequences, at least 2; at most the whole split is scored.
        samples: number of posterior samples for the ELBO, S.
        particles: number of particles for PLL, IWAE and FIVO, K.
        futures: number of futures for the open-loop score, K.
        context: number of steps that the model observes before the open-loop score begins.
        batch_size: number of sequences per batch.
        seed: random seed for the noise. The same seed and batch size give the same scores.

    Returns:
        Mean and standard error over sequences, or stored episodes, by metric, in nats per sequence; `ess` as a
        fraction of K.

    Raises:
        ForbesError: if a score does not exist or is not finite, a number is below 1, there are fewer than two
            sequences, one of them ends within the context, or a `ModelAdapter` does not do what it must.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> model = forbes.WorldModel.for_data(data).model
        >>> scores = forbes.evaluate(model, data, scores=["elbo"], sequences=10, samples=2)
        >>> sorted(scores)
        ['elbo', 'kl', 'reconstruction']
    """
    if unknown := [name for name in scores if name not in PASSES]:
        raise ForbesError(f"evaluate: there is no score {unknown[0]}, expected some of {', '.join(PASSES)}")
    require_at_least(1, "evaluate", samples=samples, particles=particles, futures=futures, context=context)
    require_at_least(1, "evaluate", batch_size=batch_size)
    count = min(sequences, data.source.size(split))
    if count < 2:
        raise ForbesError(f"evaluate: a standard error needs at least 2 sequences, found {count}. Choose more")
    if isinstance(model, ModelAdapter):
        check_model(model, data, type(model).__name__)
    episodes = data.source.episodes(split, torch.arange(count))
    numbers = {"samples": samples, "particles": particles, "futures": futures}
    found: dict[str, Estimate] = {}
    for name in scores:
        score = make_scorer(name, numbers[PASSES[name]], batch_size, context).of(model)
        if not score.metrics:  # the model has none of them
            continue
        if score.context:
            require_longer("evaluate", data, split, count, score.context)
        scored = score_split(model, split_batches(data, split, count, score.batch_size), score, seed)
        found |= {metric: Estimate.of(scored.total(metric), episodes) for metric in score.metrics}
    return found


_EXACT_ROWS = 20  # sequences; a belief on a fine grid takes 3 MB per sequence


def exact_scorer(process: Process) -> Scorer:
    """Build the scorer of the process's exact evidence `log_p`, the sum of its one-step predictive log-likelihoods.

    No bound exceeds it, and no belief has a higher prequential score in expectation.
    """

    def function(model: BeliefModel, batch: SequenceBatch) -> Increments:
        return {"log_p": process.exact_filter(batch.observation, batch.action).step_log_likelihood}

    return Scorer(("log_p",), "exact", function, _EXACT_ROWS)


class PartialScores:
    """Scores of finished batches, one file each, so that an interrupted evaluation resumes where it stopped.

    Args:
        folder: folder that holds them until the evaluation is recorded.
        key: everything that the scores depend on. Scores saved under another key are not found.
    """

    def __init__(self, folder: Path, *key: object) -> None:
        self.folder = folder / hashlib.sha256(repr(key).encode()).hexdigest()[:16]

    def read(self, first: int) -> Increments | None:
        """Return the scores of the batch that begins with sequence `first`, or None if they were not saved."""
        path = self._path(first)
        if not path.exists():
            return None
        arrays = read_npz(path, f"Delete {self.folder}, and evaluate again")
        return {name: torch.from_numpy(values) for name, values in arrays.items()}

    def write(self, first: int, scores: Increments) -> None:
        """Save the scores of the batch that begins with sequence `first`."""
        content = io.BytesIO()
        np.savez(content, **{name: values.numpy() for name, values in scores.items()})  # type: ignore[arg-type]
        replace_file(self._path(first), content.getvalue())

    def remove(self) -> None:
        """Delete the saved scores, once the evaluation is recorded."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):  # not empty: other evaluations have saved scores there
            self.folder.parent.rmdir()

    def _path(self, first: int) -> Path:
        return self.folder / f"{first}.npz"


def score_split(
    model: BeliefModel,
    batches: Iterable[tuple[int, SequenceBatch]],
    score: Scorer,
    seed: int = 0,
    where: str = "the model",
    parts: PartialScores | None = None,
    per_rank: bool = False,
) -> Scores:
    """Score every sequence.

    Args:
        model: model in eval mode. Scores are computed on its device.
        batches: index of the first sequence of each batch, and the batch on the CPU.
        score: scorer to apply.
        seed: random seed for the noise, which depends on nothing else but the batches. These are halved where memory
            does not suffice.
        where: name of the model and the split, for error messages.
        parts: scores saved by an interrupted evaluation; new ones are saved there too.
        per_rank: whether all ranks call this, and share the batches out. Each gets all scores.

    Raises:
        ForbesError: if a score is not finite (names the sequence), or if the memory does not suffice for one sequence.
    """
    device = next(model.parameters()).device
    of_rank: dict[int, Scores] = {}  # by the index of the first sequence
    mine = itertools.islice(batches, rank(), None, num_ranks()) if per_rank else batches
    for first, batch in mine:
        values = parts.read(first) if parts else None
        if values is None:
            values = _score(model, first, batch.to(device), score, seed, where)
            require_finite(where, first, values)
            if parts:
                parts.write(first, values)
        scored = batch.mask.clone()  # (B, T)
        scored[:, : score.context] = False
        of_rank[first] = Scores(values, scored)
    by_first = {k: v for scores in (of_all_ranks(of_rank) if per_rank else [of_rank]) for k, v in scores.items()}
    found = [by_first[first] for first in sorted(by_first)]
    merged = {name: torch.cat([scores.values[name] for scores in found]) for name in score.metrics}  # (N, T)
    return Scores(merged, torch.cat([scores.mask for scores in found]))


def _score(model: BeliefModel, first: int, batch: SequenceBatch, score: Scorer, seed: int, where: str) -> Increments:
    """Score a batch; if it does not fit into memory, score its halves."""
    try:
        with forked(batch.mask.device, derive_seed(seed, "evaluation", first)):
            scores = score.function(model, batch)
        return {name: scores[name].cpu() for name in score.metrics}  # (B, T)
    except RuntimeError as error:
        if not _out_of_memory(error):
            raise
    half = len(batch.mask) // 2
    if half == 0:
        raise ForbesError(f"{where}: no memory for one sequence with {score.tag}. Choose fewer particles or samples")
    print(f"{where}: no memory for {len(batch.mask)} sequences at once, trying {half}", file=sys.stderr, flush=True)
    halves = (
        _score(model, first, batch.rows(slice(half)), score, seed, where),
        _score(model, first + half, batch.rows(slice(half, None)), score, seed, where),
    )
    return {name: torch.cat([scores[name] for scores in halves]) for name in score.metrics}


def _out_of_memory(error: RuntimeError) -> bool:
    """Return whether torch ran out of memory. On the CPU there is no exception class for it."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def require_longer(where: str, data: SequenceData, split: Split, count: int, context: int) -> None:
    """Raise a ForbesError if one of the first `count` sequences ends within the context: no step is left to score."""
    for first, batch in split_batches(data, split, count, batch_size=500):
        length = batch.mask.sum(1)  # (B,)
        row = int(length.argmin())
        if length[row] <= context:
            raise ForbesError(
                f"{where}, {split} split: sequence {first + row} has {length[row]} steps, expected more than the "
                f"context of {context}. Choose a smaller context, or other scores"
            )


def require_finite(where: str, first: int, scores: Increments) -> None:
    """Raise a ForbesError that names the first sequence, counted from `first`, with a score that is not finite."""
    for name, values in scores.items():
        broken = torch.nonzero(~values.isfinite().all(1))  # (n, 1)
        if len(broken):
            row = int(broken[0])
            raise ForbesError(
                f"{where}: the {name} of sequence {first + row} is {values[row].sum().item()}, expected a finite "
                "number. The likelihood gives the sequence probability 0, or the training diverged: train again with a "
                "smaller learning_rate"
            )


def with_progress(
    batches: Iterator[tuple[int, SequenceBatch]], name: str, sequences: int
) -> Iterator[tuple[int, SequenceBatch]]:
    """Yield the batches and show progress, in the first rank: a bar on a terminal, elsewhere a line per tenth."""
    if rank() > 0:
        yield from batches
        return
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
