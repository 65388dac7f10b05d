"""`forbes rollout`: record episodes of an agent as a video."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from forbes.commands.parsers.rollout import parser
from forbes.data.episodes.episode import Episode
from forbes.envs import EnvironmentProcess
from forbes.errors import ForbesError
from forbes.evaluation.agents import play_test_episode, seed_of_test_episode
from forbes.evaluation.films import camera_of, film
from forbes.evaluation.runs import find_device
from forbes.figures.dreams import curves, dream
from forbes.figures.grids import is_image, require_images
from forbes.figures.video import FORMATS, captioned, enlarged, side_by_side, tiled
from forbes.files import replace_file
from forbes.training.acting import WorldModelAgent
from forbes.training.loading import loaded_agent

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    if args.video.suffix not in FORMATS:
        found, expected = args.video.suffix or "nothing", " or ".join(FORMATS)
        raise ForbesError(f"--video {args.video}: it ends in {found}, expected {expected}. Rename it")
    videos = []
    with loaded_agent(args.run, find_device(args.device), args.acting_samples) as (agent, environment, _):
        if camera_of(environment.make) is None and not args.imagine:
            remedy = "Add --imagine 15 to draw them as curves; for the return alone, run: forbes evaluate " + args.run
            require_images(args.run, environment.observation_shape, remedy)
        for number in range(args.episodes):
            episode = play_test_episode(agent, environment, args.seed, number)
            steps = f"{len(episode.reward) - 1:,} agent steps, {episode.frames:,} env steps"
            print(f"episode {number + 1}: return {episode.total_reward:.2f}, {steps}", flush=True)
            seed = seed_of_test_episode(args.seed, number)
            shown = _pictures(agent, environment, episode, seed)
            if args.imagine:
                shown = _beside(agent, episode, shown, args.imagine, seed)
            assert shown is not None  # of observations that are no images, and without a camera
            videos.append(shown)
    replace_file(args.video, FORMATS[args.video.suffix]([tiled([*map(enlarged, videos)])] if args.grid else videos))
    print(args.video)


def _pictures(
    agent: WorldModelAgent, environment: EnvironmentProcess, episode: Episode, seed: int
) -> NDArray[np.uint8] | None:
    """Return the observed images of an episode, or those of a camera, `(T + 1, C, H, W)`; None if there is none."""
    if is_image(environment.observation_shape):
        return _to_bytes(agent.model.likelihood.picture(torch.from_numpy(episode.observation)))
    if (make := camera_of(environment.make)) is None:
        return None
    with EnvironmentProcess(make, time_limit=len(episode.action) - 1) as camera:
        return film(camera, episode, seed)


def _beside(
    agent: WorldModelAgent, episode: Episode, shown: NDArray[np.uint8] | None, horizon: int, seed: int
) -> NDArray[np.uint8]:
    """Show an episode, and beside it what the agent imagined: images, or the numbers of vectors as curves."""
    imagined = dream(agent.model, episode, horizon, seed)
    caption = f"imagined, up to {horizon} steps ahead"
    if episode.observation.ndim == 4:
        dreamt = captioned(enlarged(_to_bytes(imagined)), caption)
    else:
        vectors = imagined.float().cpu().numpy()
        height = 256 if shown is None else enlarged(shown).shape[2]
        dreamt = captioned(
            curves(episode.observation, vectors, horizon, height), f"observed (black), {caption} (orange)"
        )
    return side_by_side([*([] if shown is None else [captioned(enlarged(shown), "what happened")]), dreamt])


def _to_bytes(frames: torch.Tensor) -> NDArray[np.uint8]:
    """Return images of values in [0, 1] as bytes."""
    return (255 * frames.float().cpu()).round().clamp(0, 255).to(torch.uint8).numpy()
