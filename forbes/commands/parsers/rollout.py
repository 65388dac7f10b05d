"""The arguments of `forbes rollout`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive
from forbes.commands.parsers.evaluate import add_acting_samples

__all__ = ["parser"]

_DESCRIPTION = """\
Let the agent of a run play without exploration, and film it.

  forbes rollout runs/agent/forbes-0 --video agent.gif
  forbes rollout runs/agent/forbes-0 --video agent.gif --episodes 3 --seed 1

Writes a GIF of what the agent is shown, all episodes one after the other, and prints the return of each, its agent
steps (actions) and env steps (frames, with action repeat). They are the first episodes that `forbes evaluate` plays
with the same seed and --acting-samples."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes rollout`."""
    command = ArgumentParser("forbes rollout", _DESCRIPTION)
    command.add_argument("run", metavar="RUN", help="run folder of an agent that `forbes fit` has made")
    command.add_argument("--video", type=Path, required=True, metavar="GIF", help="file to write")
    command.add_argument("--episodes", type=positive, default=1, help="how many (default: 1)")
    add_acting_samples(command)
    command.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    command.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 … (default: auto)")
    return command
