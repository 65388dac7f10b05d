"""Where the jobs of `forbes compare` and `forbes reproduce` run: processes of this machine, Ray tasks, SLURM jobs."""

import importlib
from pathlib import Path
from typing import Any

from forbes.commands.jobs import Launcher
from forbes.commands.launchers.local import Local
from forbes.commands.parsers.launchers import require_used
from forbes.errors import ForbesError

__all__ = ["open_launcher"]

_MANY = 256  # jobs that are waited for at the same time on a cluster


def open_launcher(args: Any, folder: Path, at_once: int) -> Launcher:
    """Return the launcher that a command line asks for.

    Args:
        args: parsed options of `forbes.commands.parsers.launchers.add_launcher_options`.
        folder: output folder of the command.
        at_once: number of jobs on this machine.

    Raises:
        ForbesError: if the launcher's package is missing, or does not use an option.
    """
    require_used(args)
    if args.launcher == "local":
        return Local(at_once)
    package = {"ray": "ray", "slurm": "submitit"}[args.launcher]
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise ForbesError(
            f"--launcher {args.launcher}: {package} is not installed. pip install 'forbes[{args.launcher}]'"
        ) from error
    if args.launcher == "ray":
        from forbes.commands.launchers.ray import Ray

        return Ray(folder, args.address, args.cpus_per_job or 1, args.gpus_per_job or 0.0, args.jobs or _MANY)
    from forbes.commands.launchers.slurm import Slurm

    return Slurm(folder, args.slurm or (), args.jobs or _MANY)
