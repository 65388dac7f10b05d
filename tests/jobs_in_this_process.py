"""Stand-ins for the processes of jobs: a process of its own would spend most of a test on its imports."""

import contextlib
import io

from forbes.commands.cli import main
from forbes.commands.jobs import Ended
from forbes.errors import ForbesError

__all__ = ["configuration_here", "run_here"]


def run_here(jobs, launcher, later=0.0, on_end=lambda ended: None):
    """Stand in for `run_jobs`."""
    found = []
    for job in jobs:
        command = list(job.current())
        status = 2 if job.refused else main(command[command.index("forbes") + 1 :])
        found.append(Ended(job, status, 0.01, "its last <line>"))
        on_end(found[-1])
    return found


def configuration_here(config, *flags):
    """Stand in for the process that prints a configuration."""
    with contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.redirect_stderr(io.StringIO()) as told:
        try:
            status = main(["fit", "--config", config, *flags, "--print_config"])
        except SystemExit as done:
            status = done.code
    if status != 0:
        raise ForbesError(told.getvalue().splitlines()[-1].removeprefix("forbes: "))
    return printed.getvalue()
