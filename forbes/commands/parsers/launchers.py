"""The options that choose where trainings run."""

import argparse
from typing import Any

from forbes.commands.arguments import positive
from forbes.errors import ForbesError

__all__ = ["add_launcher_options", "require_used"]

_USED = {"local": (), "ray": ("address", "cpus_per_job", "gpus_per_job"), "slurm": ("slurm",)}
"""Options that only one launcher uses."""


def add_launcher_options(command: argparse.ArgumentParser, jobs: str) -> None:
    """Add the options; `jobs` is the default number of jobs on this machine, in words."""
    group = command.add_argument_group("where the trainings run (docs/scale.md)")
    group.add_argument(
        "--jobs",
        type=positive,
        metavar="N",
        help=f"trainings at a time (default: {jobs}; on a cluster, as many as it has room for)",
    )
    group.add_argument(
        "--launcher", choices=tuple(_USED), default="local", help="this machine, Ray or SLURM (default: local)"
    )
    group.add_argument("--address", metavar="HOST:PORT", help="of a Ray cluster (default: RAY_ADDRESS, or one here)")
    group.add_argument("--cpus-per-job", type=positive, metavar="N", help="CPUs of a Ray task (default: 1)")
    group.add_argument("--gpus-per-job", type=_share, metavar="X", help="GPUs of a Ray task, e.g. 0.25 (default: 0)")
    group.add_argument(
        "--slurm",
        nargs="+",
        metavar="KEY=VALUE",
        help="options of sbatch for each job, with time in minutes: partition=gpu time=240 gpus_per_node=1 "
        "cpus_per_task=4 mem=16G",
    )


def require_used(args: Any) -> None:
    """Refuse an option of another launcher.

    Raises:
        ForbesError: for the first one.
    """
    for launcher, options in _USED.items():
        for option in options:
            if launcher != args.launcher and getattr(args, option) is not None:
                flag = option.replace("_", "-")
                raise ForbesError(f"--{flag}: is for --launcher {launcher}, not {args.launcher}. Change one of them")


def _share(text: str) -> float:
    """Parse a part of a GPU, or a number of GPUs (an argparse type)."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not (0 <= value <= 1 or (value > 1 and value.is_integer())):
        raise argparse.ArgumentTypeError(f"{text} is not a number of GPUs, e.g. 0.25, 1 or 2")
    return value
