"""`forbes rollout`: an agent plays, and is filmed."""

from collections.abc import Sequence
from pathlib import Path

from forbes.arguments import ArgumentParser, positive
from forbes.errors import ForbesError
from forbes.evaluation.agents import add_acting_samples, play_test_episode
from forbes.evaluation.runs import find_device
from forbes.figures.grids import require_images
from forbes.figures.video import gif
from forbes.files import replace_file
from forbes.training.loading import loaded_agent

__all__ = ["main"]

_DESCRIPTION = """\
Let the agent of a run play without exploration, and film it.

  forbes rollout runs/agent/forbes-0 --video agent.gif
  forbes rollout runs/agent/forbes-0 --video agent.gif --episodes 3 --seed 1

Writes a GIF of what the agent is shown, all episodes one after the other, and prints the return of each, its agent
steps (actions) and env steps (frames, with action repeat). They are the first episodes that `forbes evaluate` plays
with the same seed and --acting-samples."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = _parser().parse_args(argv)
    if args.video.suffix != ".gif":
        raise ForbesError(
            f"--video {args.video}: it ends in {args.video.suffix or 'nothing'}, expected .gif. Rename it"
        )
    frames = []
    with loaded_agent(args.run, find_device(args.device), args.acting_samples) as (agent, environment):
        remedy = f"Train on pixels; the return is told by: forbes evaluate {args.run}"
        require_images(args.run, environment.observation_shape, remedy)
        for number in range(args.episodes):
            episode = play_test_episode(agent, environment, args.seed, number)
            steps = f"{len(episode.reward) - 1:,} agent steps, {episode.frames:,} env steps"
            print(f"episode {number + 1}: return {episode.total_reward:.2f}, {steps}", flush=True)
            frames.append(episode.observation)
    replace_file(args.video, gif(frames))
    print(args.video)


def _parser() -> ArgumentParser:
    parser = ArgumentParser("forbes rollout", _DESCRIPTION)
    parser.add_argument("run", metavar="RUN", help="run folder of an agent that `forbes fit` has made")
    parser.add_argument("--video", type=Path, required=True, metavar="GIF", help="file to write")
    parser.add_argument("--episodes", type=positive, default=1, help="how many (default: 1)")
    add_acting_samples(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda, cuda:1 …")
    return parser
