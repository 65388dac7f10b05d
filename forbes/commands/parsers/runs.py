"""The arguments of `forbes runs`."""

from forbes.commands.arguments import ArgumentParser

__all__ = ["parser"]

_DESCRIPTION = """\
List runs, or show one of them.

  forbes runs                        # all runs below runs/
  forbes runs runs/compare           # those below another folder
  forbes runs show runs/compare/forbes-0

The table has for each run its method, data, seed, updates, env steps (of agents), last score while training (the
validation bound in nats per sequence, or the return without exploration), age since its last start, and state:

  running    its process is alive; of another machine: its metrics are less than ten minutes old
  finished   it trained to the end
  stopped    by Ctrl-C or SIGTERM; `forbes fit --resume RUN` continues it
  failed     it diverged, or ended by an error, or was killed

`show` draws the curves of a run, with its command, commit, hours and recorded scores."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes runs`."""
    command = ArgumentParser("forbes runs", _DESCRIPTION)
    command.add_argument("what", nargs="*", metavar="DIR | show RUN", help="folder of runs (default: runs), or one run")
    return command
