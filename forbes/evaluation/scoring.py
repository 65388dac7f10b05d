"""Score a model on a whole split, batch by batch: bounded memory, finite numbers only, and resumable."""

import hashlib
import io
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
from forbes.data import SequenceBatch, SequenceDataModule, Split
from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import split_batches
from forbes.evaluation.scores import Increments, score_open_loop, score_particles, score_predictions, score_trajectories
from forbes.files import replace_file
from forbes.models import BeliefModel, StateSpaceModel
from forbes.pomdps import Process
from forbes.reading import read_npz
from forbes.seeding import derive_seed

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
    """One way through the data, which gives one score or several."""

    metrics: tuple[str, ...]
    """The scores it is asked for, of those the function gives."""
    tag: str
    """Numbers of samples and the like, part of each metric's name."""
    function: Callable[[Any, SequenceBatch], Increments]
    """Of a model that has at least one of the metrics, and a batch."""
    batch_size: int
    """Sequences at a time."""
    context: int = 0
    """Steps at the beginning that are seen and not scored."""

    def of(self, model: BeliefModel) -> "Scorer":
        """Leave the bounds out for a model without a posterior: its likelihood is exact, and `pll` gives it."""
        bounds = () if isinstance(model, StateSpaceModel) else _BOUNDS
        return self._replace(metrics=tuple(metric for metric in self.metrics if metric not in bounds))


class Scores(NamedTuple):
    """What a pass found for every sequence, in nats, float64 on the CPU."""

    values: Increments
    """By metric, what each step adds, 0 on padding, `(N, T)`."""
    mask: Tensor
    """True where the step counts: neither padding nor context, `(N, T)`."""

    @property
    def steps(self) -> Tensor:
        """Steps of each sequence that count, `(N,)`."""
        return self.mask.sum(1)

    def total(self, metric: str) -> Tensor:
        """Return each sequence's score, `(N,)`: the sum over its steps, of the effective sample size the mean."""
        total = self.values[metric].sum(1)
        return total / self.steps if metric == "ess" else total


_BOUNDS = ("elbo", "reconstruction", "kl", "iwae", "fivo", "ess")
_FIVO_ROWS = 16
"""FIVO holds all particles of a sequence at once: so many rows for each sequence of another pass's batch."""


def make_scorer(name: str, number: int, batch_size: int, context: int) -> Scorer:
    """Build one of the passes that `forbes evaluate --scores` names.

    Args:
        name: elbo (with its parts), pll (and the IWAE of the same trajectories), fivo (with its effective sample
            size), or open-loop.
        number: of samples S, particles or futures K.
        batch_size: sequences at a time.
        context: c, the steps that the open-loop score shows the model.
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
    data: SequenceDataModule,
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
        model: `world.model` of a `WorldModel`; its device is where the scores are computed.
        data: of the sequences.
        scores: of elbo, pll, fivo and open-loop. Each gives several metrics: elbo its parts, pll the IWAE bound too,
            fivo the effective sample size, open-loop its marginals. A `VectorModel` has no bounds.
        split: train, validation or test.
        sequences: how many are scored, at most the whole split, at least 2.
        samples: S of the ELBO.
        particles: K of PLL, IWAE and FIVO.
        futures: K of the open-loop score.
        context: number of steps that the open-loop score shows the model.
        batch_size: sequences at a time.
        seed: random seed of the noise; the same seed and batch size give the same numbers.

    Returns:
        Mean and standard error over the sequences by metric, in nats per sequence; `ess` as a share of K.

    Raises:
        ForbesError: for a score that does not exist, fewer than two sequences, or a score that is not finite.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> model = forbes.WorldModel.for_data(data).model
        >>> scores = forbes.evaluate(model, data, scores=["elbo"], sequences=10, samples=2)
        >>> sorted(scores)
        ['elbo', 'kl', 'reconstruction']
    """
    if unknown := [name for name in scores if name not in PASSES]:
        raise ForbesError(f"evaluate: there is no score {unknown[0]}, expected some of {', '.join(PASSES)}")
    count = min(sequences, data.source.size(split))
    if count < 2:
        raise ForbesError(f"evaluate: a standard error needs at least 2 sequences, found {count}. Choose more")
    numbers = {"samples": samples, "particles": particles, "futures": futures}
    found: dict[str, Estimate] = {}
    for name in scores:
        score = make_scorer(name, numbers[PASSES[name]], batch_size, context).of(model)
        scored = score_split(model, split_batches(data, split, count, score.batch_size), score, seed)
        found |= {metric: Estimate.of(scored.total(metric)) for metric in score.metrics}
    return found


_EXACT_ROWS = 20  # sequences; a belief on a fine grid is 3 MB each


def exact_scorer(process: Process) -> Scorer:
    """Build the pass that asks the process itself: `log_p`, the sum of its one-step predictive log-likelihoods.

    No bound is above it, and no belief has a higher prequential score in expectation.
    """

    def function(model: BeliefModel, batch: SequenceBatch) -> Increments:
        return {"log_p": process.exact_filter(batch.observation, batch.action).step_log_likelihood}

    return Scorer(("log_p",), "exact", function, _EXACT_ROWS)


class PartialScores:
    """Scores of finished batches, one file each, so that an interrupted evaluation goes on where it stopped.

    Args:
        folder: where to keep them until the evaluation is recorded.
        key: of all that the scores depend on; another key finds nothing.
    """

    def __init__(self, folder: Path, *key: object) -> None:
        self.folder = folder / hashlib.sha256(repr(key).encode()).hexdigest()[:16]

    def read(self, first: int) -> Increments | None:
        """Return the scores of the batch that begins with this sequence, None if it was not finished."""
        path = self._path(first)
        if not path.exists():
            return None
        arrays = read_npz(path, f"Delete {self.folder}, and evaluate again")
        return {name: torch.from_numpy(values) for name, values in arrays.items()}

    def write(self, first: int, scores: Increments) -> None:
        """Keep the scores of a batch."""
        content = io.BytesIO()
        np.savez(content, **{name: values.numpy() for name, values in scores.items()})  # type: ignore[arg-type]
        replace_file(self._path(first), content.getvalue())

    def remove(self) -> None:
        """Forget them, once the evaluation is recorded."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):  # other evaluations have parts there
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
) -> Scores:
    """Score every sequence.

    Args:
        model: in eval mode; its device is where to compute.
        batches: the index of the first sequence of each batch, and the batch on the CPU.
        score: what to compute.
        seed: of the noise, which depends on it and on the batches alone.
        where: the model's and the split's name, for an error.
        parts: what an interrupted evaluation has left, and where this one leaves its own.

    Raises:
        ForbesError: where a score is not finite (it names the sequence), or one sequence needs too much memory.
    """
    device = next(model.parameters()).device
    found: list[Scores] = []
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        for first, batch in batches:
            values = parts.read(first) if parts else None
            if values is None:
                values = _score(model, first, SequenceBatch(*(v.to(device) for v in batch)), score, seed, where)
                require_finite(where, first, values)
                if parts:
                    parts.write(first, values)
            counts = batch.mask.clone()  # (B, T)
            counts[:, : score.context] = False
            found.append(Scores(values, counts))
    merged = {name: torch.cat([scores.values[name] for scores in found]) for name in score.metrics}  # (N, T)
    return Scores(merged, torch.cat([scores.mask for scores in found]))


def _score(model: BeliefModel, first: int, batch: SequenceBatch, score: Scorer, seed: int, where: str) -> Increments:
    """Score a batch; where the memory does not suffice, each half of it."""
    torch.manual_seed(derive_seed(seed, "evaluation", first))
    try:
        scores = score.function(model, batch)
        return {name: scores[name].cpu() for name in score.metrics}  # (B, T)
    except RuntimeError as error:
        if not _out_of_memory(error):
            raise
    half = len(batch.mask) // 2
    if half == 0:
        raise ForbesError(f"{where}: no memory for one sequence with {score.tag}. Choose fewer particles or samples")
    print(f"{where}: no memory for {len(batch.mask)} sequences at once, trying {half}", file=sys.stderr, flush=True)
    parts = [
        _score(model, first + skip, SequenceBatch(*(values[skip:][:count] for values in batch)), score, seed, where)
        for skip, count in ((0, half), (half, len(batch.mask) - half))
    ]
    return {name: torch.cat([part[name] for part in parts]) for name in score.metrics}


def _out_of_memory(error: RuntimeError) -> bool:
    """Tell whether torch ran out of memory; on the CPU it has no class of its own for that."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def require_finite(where: str, first: int, scores: Increments) -> None:
    """Raise a ForbesError that names the first sequence, counted from `first`, with a score that is not finite."""
    for name, values in scores.items():
        broken = torch.nonzero(~values.isfinite().all(1))  # (n, 1)
        if len(broken):
            place = int(broken[0])
            raise ForbesError(
                f"{where}: the {name} of sequence {first + place} is {values[place].sum().item()}, expected a finite "
                "number. The training diverged: train again with a smaller learning_rate"
            )


def with_progress(
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
