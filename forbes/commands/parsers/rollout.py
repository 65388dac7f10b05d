"""The arguments of `forbes rollout`."""

from pathlib import Path

from forbes.commands.arguments import ArgumentParser, existing_run, positive
from forbes.commands.parsers.evaluate import add_acting_samples

__all__ = ["parser"]

_DESCRIPTION = """\
Let the agent of a run play without exploration, and record it.

  forbes rollout runs/agent/forbes-0 --video agent.gif
  forbes rollout runs/agent/forbes-0 --video agent.gif --episodes 3 --seed 1
  forbes rollout runs/agent/forbes-0 --video agent.mp4 --episodes 4 --grid --imagine 15

Writes a GIF or MP4 of all episodes, and prints the return of each episode, its agent steps (actions) and env steps
(frames, with action repeat). They are the first episodes that `forbes evaluate` plays with the same seed and
--acting-samples. It shows the observed images; the episode of an agent that observes vectors is played again with
`pixels`, an option of DeepMind Control and Gymnasium."""


def parser() -> ArgumentParser:
    """Return the parser of `forbes rollout`."""
    command = ArgumentParser("forbes rollout", _DESCRIPTION)
    command.add_argument(
        "run", metavar="RUN", type=existing_run, help="run folder of an agent, written by `forbes fit`"
    )
    command.add_argument("--video", type=Path, required=True, metavar="FILE", help="file to write, .gif or .mp4")
    command.add_argument("--episodes", type=positive, default=1, help="number of episodes (default: 1)")
    command.add_argument("--grid", action="store_true", help="show the episodes at the same time, in a grid")
    command.add_argument(
        "--imagine",
        type=positive,
        metavar="STEPS",
        help="show beside each episode what the agent imagined, up to so many steps ahead",
    )
    add_acting_samples(command)
    command.add_argument("--seed", type=int, default=0, help="random seed for the episodes (default: 0)")
    command.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 … (default: auto)")
    return command
