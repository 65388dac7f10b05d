"""`forbes rollout`: record episodes of an agent as a GIF."""

from collections.abc import Sequence

from forbes.commands.parsers.rollout import parser
from forbes.errors import ForbesError
from forbes.evaluation.agents import play_test_episode
from forbes.evaluation.runs import find_device
from forbes.figures.grids import require_images
from forbes.figures.video import gif
from forbes.files import replace_file
from forbes.training.loading import loaded_agent

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    if args.video.suffix != ".gif":
        raise ForbesError(
            f"--video {args.video}: it ends in {args.video.suffix or 'nothing'}, expected .gif. Rename it"
        )
    frames = []
    with loaded_agent(args.run, find_device(args.device), args.acting_samples) as (agent, environment, _):
        remedy = f"Train on pixels; for the return alone, run: forbes evaluate {args.run}"
        require_images(args.run, environment.observation_shape, remedy)
        for number in range(args.episodes):
            episode = play_test_episode(agent, environment, args.seed, number)
            steps = f"{len(episode.reward) - 1:,} agent steps, {episode.frames:,} env steps"
            print(f"episode {number + 1}: return {episode.total_reward:.2f}, {steps}", flush=True)
            frames.append(episode.observation)
    replace_file(args.video, gif(frames))
    print(args.video)
