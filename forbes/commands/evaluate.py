"""`forbes evaluate`: bounds and proper scores of trained models, with paired differences."""

import io
import itertools
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forbes.choices import PASSES, SUBSET, Split
from forbes.commands.parsers.evaluate import parser, require_effect
from forbes.commands.tables import (
    print_degradation,
    print_images,
    print_pairs,
    print_references,
    print_runs,
)
from forbes.data import Simulated
from forbes.errors import ForbesError
from forbes.evaluation.adapters import adapter_folder, load_all
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.image_scores import futures_of, image_curves, image_rows, score_images
from forbes.evaluation.metrics import SCORES, EvaluatedRun, compare_pairs, record_differences
from forbes.evaluation.record import describe, require_readable, results_folders, write_record
from forbes.evaluation.references import references
from forbes.evaluation.round_trip import model_round_trip, print_round_trip
from forbes.evaluation.runs import (
    TrainedRun,
    data_name,
    data_sha256,
    find_device,
    is_agent,
    require_comparable,
    require_distinct,
    split_batches,
)
from forbes.evaluation.scoring import (
    PartialScores,
    Scorer,
    exact_scorer,
    make_scorer,
    require_longer,
    score_split,
    with_progress,
)
from forbes.runs.folder import RunFolder
from forbes.runs.launched import connected, is_first, num_from_torchrun
from forbes.runs.provenance import code_sha256, command_line, origin

__all__ = ["WantedMetrics", "evaluate", "main", "wanted_metrics"]


class _Job(NamedTuple):
    """A scorer and the number of sequences that it scores."""

    name: str
    score: Scorer
    sequences: int
    """Number of sequences, from the first of the split."""
    sha256: list[str]
    """Hash of the sequences in each run's data."""
    whole: bool
    """Whether these are all sequences of the split, of every run."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments. Of several processes, the first prints and records the results."""
    with redirect_stdout(sys.stdout if is_first() else io.StringIO()):
        _main(argv)


def _main(argv: Sequence[str]) -> None:
    args = parser().parse_args(argv)
    require_distinct(args.runs)
    command = command_line("evaluate", *argv)
    if args.checkpoint is not None:
        args.runs = [str(Path(run) / "checkpoints" / args.checkpoint) for run in args.runs]
    folders = results_folders(args.runs, args.output)
    for run, folder in folders.items():
        if folder != RunFolder(run).results:
            print(f"the results of {run} go to {folder}", flush=True)
    agents = bool(args.runs) and is_agent(args.runs[0])
    require_effect(args, agents)
    if agents:
        if args.model:
            raise ForbesError(f"{args.runs[0]}: an agent is evaluated by its return, a --model has none. Name others")
        if num_from_torchrun() > 1:
            raise ForbesError(f"{args.runs[0]}: one process plays the episodes of an agent. Leave torchrun out")
        from forbes.commands.agent_tables import print_agents  # imports Lightning
        from forbes.evaluation.agents import evaluate_agents

        device = find_device(args.device)
        played = evaluate_agents(folders, args.episodes, args.acting_samples, args.seed, device, command)
        return print_agents(played)
    for words in args.model:
        folders[" ".join(words)] = adapter_folder(words, args.output)
        print(f"the results of {' '.join(words)} go to {adapter_folder(words, args.output)}", flush=True)
    require_readable(folders.values())
    runs = load_all(args.runs, args.model, args.data, find_device(args.device))
    measured = evaluate(runs, args, command, folders)
    if not is_first():
        return
    print_runs(measured)
    _tell_single_episode(measured)
    print_references(measured)
    if len(measured) > 1:
        print_pairs(compare_pairs(measured))
    print_degradation(measured)
    print_images(measured)


def _tell_single_episode(measured: Sequence[EvaluatedRun]) -> None:
    """Print that standard errors are too small, where all sequences are parts of one episode."""
    for entry in measured[0].entries.values():  # all have the same sequences
        if len({*entry.get("episode_of", (0, 1))}) == 1:
            print(
                f"all {entry['sequences']} sequences are parts of one episode: standard errors take them as "
                "independent, and are too small"
            )
            return


def evaluate(runs: Sequence[TrainedRun], args: Any, command: str, folders: Mapping[str, Path]) -> list[EvaluatedRun]:
    """Evaluate runs on the same sequences and record the results.

    Args:
        runs: runs, or models trained elsewhere.
        args: parsed options of `forbes.commands.parsers.evaluate.add_score_options`.
        command: command line, for the record.
        folders: folder for the record of each run, by its path.

    Returns:
        The runs with their scores; nothing in processes other than the first.
    """
    jobs, code = _jobs(args, runs), code_sha256()
    saved: list[PartialScores] = []
    measured = [EvaluatedRun(run, {}, {}) for run in runs]
    with connected():
        for number, evaluated in enumerate(measured):
            for job in _of(evaluated.run, jobs):
                folder, key = folders[evaluated.run.path], _key(evaluated.run, job, number, args)
                saved.append(PartialScores(folder / "evaluation-parts", code, *key))
                _measure(evaluated, job, job.sha256[number], args, saved[-1])
    if not is_first():
        return []
    about = origin(command, args.seed)
    for number, evaluated in enumerate(measured):
        _add_references(evaluated, jobs, args.split)
        measured[number] = evaluated._replace(images=_image_entries(evaluated.run, jobs, number, args))
        for entry in (*evaluated.entries.values(), *measured[number].images.values()):
            entry.update(about | {"parameters": evaluated.run.parameters})
    for first, second, differences in compare_pairs(measured):
        record_differences(first, second, differences)
    for evaluated in measured:
        entries = {**evaluated.entries, **evaluated.images, **_round_trip(evaluated.run, args)}
        write_record(folders[evaluated.run.path], entries, evaluated.totals)
    for parts in saved:
        parts.remove()
    return measured


def _add_references(evaluated: EvaluatedRun, jobs: Sequence[_Job], split: Split) -> None:
    """Add to each score the scores of the reference models on the same steps of the same sequences."""
    found: dict[int, dict[str, Tensor]] = {}
    for job in _of(evaluated.run, jobs):
        scores = [metric for metric in job.score.metrics if metric in SCORES]
        if scores and job.sequences not in found:
            found[job.sequences] = references(evaluated.run.data, evaluated.run.model.likelihood, split, job.sequences)
        for metric in scores:
            name = _metric_name(evaluated.run, job, metric, split)
            total, episodes = evaluated.totals[name], evaluated.entries[name].get("episode_of")
            evaluated.entries[name]["references"] = {
                reference: _reference(total, values[:, job.score.context :].sum(1), episodes)
                for reference, values in found[job.sequences].items()
            }


def _reference(scores: Tensor, reference: Tensor, episodes: Sequence[int] | None) -> dict[str, Any]:
    """Return the estimate of a reference, and that of the scores minus it, paired over the sequences, `(N,)` each."""
    difference = Estimate.of(scores - reference, episodes)
    return {**Estimate.of(reference, episodes)._asdict(), "difference": difference._asdict()}


def _image_entries(run: TrainedRun, jobs: Sequence[_Job], number: int, args: Any) -> dict[str, dict[str, Any]]:
    """Return the entries of PSNR and SSIM of run `number`, by metric; {} without images or an open-loop score."""
    job = next((job for job in jobs if job.name == "open-loop"), None)
    shape = run.data.observation_shape
    if job is None or not isinstance(shape, tuple) or len(shape) != 3:
        return {}
    began, futures = time.monotonic(), futures_of(run.model, args.futures)
    batches = split_batches(run.data, args.split, job.sequences, image_rows(run.data.length - args.context))
    batches = with_progress(batches, f"{run.path} images", job.sequences)
    try:
        found = score_images(run.model, run.data.source, batches, args.context, futures, args.seed)
    except NotImplementedError:  # the likelihood of an adapter may have no mean
        return {}
    about = {"sequences": job.sequences, **_about(run, job.sha256[number], began)}
    job = job._replace(score=job.score._replace(tag=f"K={futures},c={args.context}"))
    return {
        _metric_name(run, job, metric, args.split): {"unit": unit, **curves, **about}
        for metric, unit, curves in image_curves(found)
    }


class WantedMetrics(NamedTuple):
    """The metrics of `evaluate` for a run, by full name."""

    names: list[str]
    """All metrics, in their order."""
    has: dict[str, str]
    """Those that the run's model has, with the hash of the sequences that are scored."""

    @property
    def lacks(self) -> list[str]:
        """Metrics that the run's model does not have."""
        return [name for name in self.names if name not in self.has]


def wanted_metrics(runs: Sequence[TrainedRun], args: Any) -> list[WantedMetrics]:
    """Return the metrics of `evaluate` for each run."""
    jobs = _jobs(args, runs)
    found = [
        (_names(run, jobs, args.split, number), _names(run, _of(run, jobs), args.split, number))
        for number, run in enumerate(runs)
    ]
    return [WantedMetrics([*names], has) for names, has in found]


def _names(run: TrainedRun, jobs: Sequence[_Job], split: str, number: int) -> dict[str, str]:
    """Return the metrics of run `number`, with the hash of their sequences."""
    return {_metric_name(run, job, metric, split): job.sha256[number] for job in jobs for metric in job.score.metrics}


def _jobs(args: Any, runs: Sequence[TrainedRun]) -> list[_Job]:
    """Return the scorers with their sequences; refuse runs that cannot be scored or compared."""
    numbers = {name: getattr(args, option) for name, option in PASSES.items() if name in args.scores}
    scorers = {name: make_scorer(name, number, args.batch_size, args.context) for name, number in numbers.items()}
    _require_scores(runs, scorers, numbers)
    if isinstance(source := runs[0].data.source, Simulated):
        scorers = {"exact": exact_scorer(source.process)} | scorers
    most = {name: sys.maxsize if name in ("exact", "elbo") else SUBSET for name in scorers}
    counts = {name: min(_count(run, args, most[name]) for run in runs) for name in scorers}
    hashes = {count: _require_same_data(runs, args, count) for count in dict.fromkeys(counts.values())}
    if "open-loop" in counts:
        require_longer(runs[0].path, runs[0].data, args.split, counts["open-loop"], args.context)
    largest = max(run.data.source.size(args.split) for run in runs)
    return [
        _Job(name, scorer, counts[name], hashes[counts[name]], counts[name] == largest)
        for name, scorer in scorers.items()
    ]


def _require_scores(runs: Sequence[TrainedRun], scorers: Mapping[str, Scorer], numbers: Mapping[str, int]) -> None:
    """Refuse scores that no model has, and numbers of particles or futures that a model cannot use."""
    if not any(scorer.of(run.model).metrics for run in runs for scorer in scorers.values()):
        why = "does not filter by steps" if "elbo" not in runs[0].model.lacks else "has no density of a posterior"
        raise ForbesError(
            f"{runs[0].path}: a {runs[0].family} model has no {' or '.join(scorers)} score, since it {why}. Ask for "
            "--scores pll or open-loop"
        )
    for run, name in itertools.product(runs, ("pll", "open-loop")):
        if name in numbers:
            run.model.num_belief_samples(numbers[name])


def _require_same_data(runs: Sequence[TrainedRun], args: Any, count: int) -> list[str]:
    """Return the hash of the first sequences in each run's data; refuse runs that are not comparable."""
    hashes = [data_sha256(run.data, args.split, count) for run in runs]
    require_comparable(runs, hashes)
    return hashes


def _of(run: TrainedRun, jobs: Sequence[_Job]) -> list[_Job]:
    """Return the jobs of a run, without the scores that its model does not have."""
    of_run = [job._replace(score=job.score.of(run.model)) for job in jobs]
    return [job for job in of_run if job.score.metrics]


def _count(run: TrainedRun, args: Any, default: int) -> int:
    """Return the number of sequences to score."""
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


def _round_trip(run: TrainedRun, args: Any) -> dict[str, dict[str, Any]]:
    """Measure and print the round-trip error of the flows on the first batch; return its entry, {} without flows."""
    rows = min(args.batch_size, _count(run, args, sys.maxsize))
    _, batch = next(split_batches(run.data, args.split, rows, rows))
    found = model_round_trip(run.model, batch, args.seed)
    print_round_trip(run.path, found)
    return (
        {
            f"{args.split}/round_trip": found
            | {"sequences": len(batch.mask), "seed": args.seed, "checkpoint": run.checkpoint}
        }
        if found
        else {}
    )


def _metric_name(run: TrainedRun, job: _Job, metric: str, split: str) -> str:
    """Return the full name of a metric, e.g. `test[:1000]/pll[bernoulli,K=128]`."""
    part = "" if job.whole else f"[:{job.sequences}]"
    tag = job.score.tag if job.name == "exact" else f"{run.model.likelihood.name},{job.score.tag}"
    return f"{split}{part}/{metric}[{tag}]"


def _key(run: TrainedRun, job: _Job, number: int, args: Any) -> tuple[object, ...]:
    """Return what the scores of run `number` depend on, besides the code."""
    return run.checkpoint, job.sha256[number], job.name, job.score.tag, job.score.batch_size, args.seed


def _measure(evaluated: EvaluatedRun, job: _Job, sha256: str, args: Any, parts: PartialScores) -> None:
    """Score a run and add the results to it; `parts` has what an interrupted evaluation has scored."""
    run, score = evaluated.run, job.score
    began = time.monotonic()
    batches = split_batches(run.data, args.split, job.sequences, score.batch_size)
    batches = with_progress(batches, f"{run.path} {job.name}", job.sequences)
    scores = score_split(run.model, batches, score, args.seed, f"{run.path}, {args.split} split", parts, per_rank=True)
    episodes = run.data.source.episodes(args.split, torch.arange(job.sequences))
    for metric in score.metrics:
        name = _metric_name(run, job, metric, args.split)
        evaluated.totals[name] = scores.total(metric)
        evaluated.entries[name] = describe(scores, metric, episodes) | _about(run, sha256, began)


def _about(run: TrainedRun, sha256: str, began: float) -> dict[str, Any]:
    """Return what was measured, where, and for how long."""
    return {
        "data": {"name": data_name(run.data), "sha256": sha256},
        "checkpoint": run.checkpoint,
        "device": str(next(run.model.parameters()).device),
        "seconds": round(time.monotonic() - began, 1),
    }
