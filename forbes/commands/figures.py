"""`forbes figures`: draw the paper's figures from run folders."""

import argparse
import re
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import pandas as pd
import torch
from matplotlib.figure import Figure

from forbes.commands.parsers.figures import parser
from forbes.data import Strokes
from forbes.errors import ForbesError
from forbes.evaluation.predictions import whole_sequences
from forbes.evaluation.record import read_record
from forbes.evaluation.references import reference_means
from forbes.evaluation.runs import TrainedRun, data_name, data_sha256, load_runs, require_comparable, run_titles
from forbes.figures.returns import returns_against_env_steps
from forbes.figures.strokes import FamilyCurves, ambiguous_digits, elbo_against_updates, predictions
from forbes.figures.style import PALETTE, save_png_and_pdf
from forbes.runs.folder import RunFolder, read_config, read_metrics

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    if args.experiment == "agents":
        _save(returns_against_env_steps(*_agents(args.runs)), args.output, "returns")
    else:
        _strokes(args)


def _strokes(args: argparse.Namespace) -> None:
    """Draw Figures 4 and 5."""
    runs = load_runs(args.runs)
    for run in runs:
        if not isinstance(run.data.source, Strokes):
            raise ForbesError(f"{run.path}: its data are {data_name(run.data)}, expected Strokes. Name other runs")
    data = runs[0].data
    require_comparable(runs, [data_sha256(run.data, "test", min(500, run.data.source.size("test"))) for run in runs])
    if not args.context < data.length:
        raise ForbesError(f"--context {args.context}: expected less than the length of the sequences, {data.length}")
    families = group(runs)

    index = _index(args.index, data.source.size("test")) if args.index else ambiguous_digits(data, args.context)
    batch = whole_sequences(data, "test", index)
    for time in sorted({data.length, batch.observation.shape[1]}):
        figure = predictions(families, data.source, batch, time, args.context, args.samples, args.mean)
        _save(figure, args.output, f"predictions-t{time}")
    count = min(data.validation_sequences, data.source.size("validation"))
    means = reference_means(data, runs[0].model.likelihood, "validation", count)
    _save(elbo_against_updates(families, means), args.output, "elbo")


def _agents(runs: Sequence[str]) -> tuple[str, dict[str, list[pd.Series]]]:
    """Return the task of the agents, and the curves of their returns, one per seed, by name."""
    curves: dict[str, list[pd.Series]] = {}
    tasks = set()
    for run in runs:
        metrics = read_metrics(run)
        if not {"env_steps", "return/acting"} <= {*metrics}:
            raise ForbesError(f"{run}: metrics.jsonl has no return/acting. Name runs of agents with measured returns")
        tasks.add(_task(RunFolder(run).config))
        name = re.sub(r"-\d+$", "", Path(run).absolute().name)
        measured = metrics[["env_steps", "return/acting"]].dropna()
        curves.setdefault(name, []).append(measured.set_index("env_steps")["return/acting"])
    if len(tasks) > 1:
        raise ForbesError(
            f"--runs: the tasks are {' and '.join(sorted(tasks))}, expected one task. Draw each task separately"
        )
    return tasks.pop(), curves


def _task(path: Path) -> str:
    """Return the task in an agent's configuration."""
    try:
        return str(read_config(path)["data"]["init_args"]["source"]["init_args"]["task"])
    except (KeyError, TypeError) as error:
        raise ForbesError(f"{path}: its data have no task, expected Experience. Name runs of agents") from error


def group(runs: Sequence[TrainedRun]) -> list[FamilyCurves]:
    """Group runs into families, whose configurations differ only in the seed."""
    members: list[list[TrainedRun]] = []
    for run in runs:
        same = next((others for others in members if others[0].config == run.config), None)
        if same is None:
            members.append([run])
        else:
            same.append(run)
    families = []
    titles = run_titles([first for first, *_ in members])
    for runs_of_one, title, colour in zip(members, titles, cycle(PALETTE), strict=False):
        tests = [value for run in runs_of_one if (value := _test_elbo(run)) is not None]
        families.append(FamilyCurves(title, colour, runs_of_one[0].model, [_curve(run) for run in runs_of_one], tests))
    return families


def _curve(run: TrainedRun) -> pd.Series:
    """Return the bound on the validation split, indexed by update."""
    metrics = read_metrics(run.path)
    name = f"val/{run.model.bound_name}"
    if name not in metrics:
        raise ForbesError(f"{run.path}: metrics.jsonl has no {name}. Train the run to its first validation")
    return metrics[name].dropna()


def _test_elbo(run: TrainedRun) -> float | None:
    """Return the recorded ELBO of this checkpoint on the whole test split; None if missing, or for other bounds."""
    if not run.model.bound_name.startswith("elbo["):
        return None
    entries = {
        name: entry for name, entry in read_record(run.path).items() if entry.get("checkpoint") == run.checkpoint
    }
    return next((entry["mean"] for name, entry in entries.items() if name.startswith("test/elbo[")), None)


def _index(index: Sequence[int], size: int) -> torch.Tensor:
    for value in index:
        if not 0 <= value < size:
            raise ForbesError(f"--index {value}: the test split has {size} digits, expected 0 to {size - 1}")
    return torch.tensor(index)


def _save(figure: Figure, folder: Path, name: str) -> None:
    print(*save_png_and_pdf(figure, folder, name), sep="\n")
