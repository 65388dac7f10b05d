"""The arguments of `forbes rollout`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, positive
from forbes.commands.parsers.evaluate import add_acting_samples

__all__ = ["parser"]

_DESCRIPTION = """\
Let the agent of a run play without exploration, and record it.

  forbes rollout runs/agent/forbes-0 --video agent.gif
  forbes rollout runs/agent/forbes-0 --video agent.gif --episodes 3 --seed 1

Writes a GIF of the agent's observations in all episodes, and prints the return of each episode, its agent steps
(actions) and env steps (frames, with action repeat). They are the first episodes that `forbes evaluate` plays with the
same seed and --acting-samples."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes rollout`."""
    command = ArgumentParser("forbes rollout", _DESCRIPTION)
    command.add_argument("run", metavar="RUN", help="run folder of an agent, written by `forbes fit`")
    command.add_argument("--video", type=Path, required=True, metavar="GIF", help="file to write")
    command.add_argument("--episodes", type=positive, default=1, help="number of episodes (default: 1)")
    add_acting_samples(command)
    command.add_argument("--seed", type=int, default=0, help="random seed for the episodes (default: 0)")
    command.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 … (default: auto)")
    return command
