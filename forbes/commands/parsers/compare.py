"""The arguments of `forbes compare`."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from forbes.commands.arguments import ArgumentParser, positive
from forbes.commands.parsers.evaluate import add_score_options
from forbes.commands.parsers.launchers import add_launcher_options
from forbes.errors import ForbesError

__all__ = ["parser", "require_no_scores", "require_sweep"]

_DESCRIPTION = """\
Train configurations with several seeds, evaluate all runs on the same sequences, and compare them.

  forbes compare strokes/rssm strokes/forbes --seeds 3
  forbes compare strokes/rssm strokes/forbes -o runs/dejong -- --data.source.origin dejong

Each run has a folder DIR/NAME-SEED. Arguments after -- are passed to every `forbes fit`. Runs that have no scores yet
are then evaluated as by `forbes evaluate`. Writes comparison.csv, .json and .md, and figures: scores, per-step,
differences (to the first configuration). Agents are compared by their returns, in the tables of `forbes evaluate`, and
play anew each time. If interrupted, the same command resumes where it stopped.

  forbes compare strokes/{rssm,forbes,mixture} --seeds 5 --jobs 2     # two trainings at a time, a progress line each
  forbes compare strokes/rssm strokes/forbes --launcher ray --gpus-per-job 0.25
  forbes compare strokes/rssm strokes/forbes --launcher slurm --slurm partition=gpu time=240 gpus_per_node=1
  forbes compare strokes/forbes --sweep model.learning_rate=1e-3,3e-3 model.state_dim=4,8 --seeds 2

A training that crashes, or whose machine is lost, is begun again from its checkpoint, until it has crashed three times
in a row without a new one; a repeated command counts from zero. Trainings that are not finished are listed with their
reasons at the end; the others finish."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes compare`."""
    command = ArgumentParser("forbes compare", _DESCRIPTION)
    command.add_argument(
        "configs", nargs="+", metavar="CONFIG", help="configurations, by name or path; differences are to the first one"
    )
    command.add_argument(
        "--seeds", type=positive, default=1, help="runs per configuration, with seeds 0, 1, … (default: 1)"
    )
    command.add_argument(
        *("-o", "--output"),
        type=Path,
        default=Path("runs/compare"),
        metavar="DIR",
        help="output folder (default: runs/compare)",
    )
    command.add_argument(
        "--sweep",
        nargs="+",
        metavar="KEY=V1,V2",
        help="train a grid of one configuration, and rank it by the best validation; nothing is evaluated",
    )
    add_launcher_options(command, "1; they share the CPU threads")
    measures = command.add_argument_group("evaluation, as in forbes evaluate")
    add_score_options(measures)
    return command


def require_sweep(args: Any) -> None:
    """Refuse what a sweep does not use.

    Raises:
        ForbesError: for a second configuration, or an option of the evaluation.
    """
    if len(args.configs) > 1:
        raise ForbesError(
            f"--sweep: takes one configuration, found {', '.join(args.configs)}. Sweep one after the other"
        )
    require_no_scores(args, "a sweep is ranked by its validation, nothing is evaluated")


def require_no_scores(args: Any, reason: str, used: Collection[str] = ()) -> None:
    """Raise a ForbesError for an option of the evaluation that has no effect, all but those that are used."""
    scores = ArgumentParser("", "")
    add_score_options(scores)
    for name, default in vars(scores.parse_args([])).items():
        if name not in used and getattr(args, name) != default:
            flag = name.replace("_", "-")
            raise ForbesError(f"--{flag}: {reason}. Remove --{flag}")
