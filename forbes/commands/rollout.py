"""`forbes rollout`: record episodes of an agent as a video."""

import sys
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forbes.commands.parsers.rollout import parser
from forbes.data.episodes.episode import Episode
from forbes.envs import Environment, EnvironmentProcess
from forbes.errors import ForbesError
from forbes.evaluation.agents import play_test_episode, seed_of_test_episode
from forbes.evaluation.films import camera_of, film
from forbes.evaluation.runs import find_device
from forbes.figures.dreams import curves, dream
from forbes.figures.grids import is_image, require_images
from forbes.figures.video import FORMATS, captioned, enlarged, require_format, side_by_side, tiled
from forbes.files import replace_file
from forbes.models import Likelihood, PartsLikelihood
from forbes.shapes import map_parts
from forbes.training.acting import WorldModelAgent
from forbes.training.loading import loaded_agent

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    require_format(args.video)
    videos = []
    with loaded_agent(args.run, find_device(args.device), args.acting_samples) as (agent, environment, _):
        make = _camera(environment)
        if make is None and not args.imagine:
            remedy = "Add --imagine 15 to draw them as curves; for the return alone, run: forbes evaluate " + args.run
            require_images(args.run, environment.observation_shape, remedy)
        for number in range(args.episodes):
            episode = play_test_episode(agent, environment, args.seed, number)
            steps = f"{len(episode.reward) - 1:,} agent steps, {episode.frames:,} env steps"
            print(f"episode {number + 1}: return {episode.total_reward:.2f}, {steps}", flush=True)
            seed = seed_of_test_episode(args.seed, number)
            shown = _pictures(agent, environment, make, episode, seed)
            if args.imagine:
                shown = _beside(agent, episode, shown, args.imagine, seed)
            assert shown is not None  # of observations that are no images, and without a camera
            videos.append(shown)
    replace_file(args.video, FORMATS[args.video.suffix]([tiled([*map(enlarged, videos)])] if args.grid else videos))
    print(args.video)


def _camera(environment: EnvironmentProcess) -> Callable[[], Environment] | None:
    """Return a function that makes the environment with a camera; None if it is not needed, or there is none."""
    if is_image(environment.observation_shape) or (make := camera_of(environment.make)) is None:
        return None
    try:
        EnvironmentProcess(make).close()
    except ForbesError as error:
        print(f"no camera: {error}", file=sys.stderr)
        return None
    return make


def _pictures(
    agent: WorldModelAgent,
    environment: EnvironmentProcess,
    make: Callable[[], Environment] | None,
    episode: Episode,
    seed: int,
) -> NDArray[np.uint8] | None:
    """Return the observed images of an episode, or those of a camera, `(T + 1, C, H, W)`; None if there is none."""
    if is_image(environment.observation_shape):
        return _to_bytes(agent.model.likelihood.images(_seen(agent, episode)))
    if make is None:
        return None
    with EnvironmentProcess(make, time_limit=len(episode.action) - 1) as camera:
        return film(camera, episode, seed)


def _beside(
    agent: WorldModelAgent, episode: Episode, shown: NDArray[np.uint8] | None, horizon: int, seed: int
) -> NDArray[np.uint8]:
    """Show an episode, and beside it what the agent imagined: images, and the numbers of vectors as curves."""
    likelihood, imagined = agent.model.likelihood, dream(agent.model, episode, horizon, seed)
    caption = f"imagined, up to {horizon} steps ahead"
    columns = [] if shown is None else [captioned(enlarged(shown), "what happened")]
    seen_numbers, numbers = (_vectors(likelihood, values.cpu()) for values in (_seen(agent, episode), imagined))
    parts = likelihood.parts.values() if isinstance(likelihood, PartsLikelihood) else [likelihood]
    if any(part.rank == 3 for part in parts):
        columns.append(captioned(enlarged(_to_bytes(likelihood.images(imagined))), caption))
    if seen_numbers is not None and numbers is not None:
        height = 256 if shown is None else enlarged(shown).shape[2]
        drawn = curves(seen_numbers.numpy(), numbers.float().numpy(), horizon, height)
        columns.append(captioned(drawn, f"observed (black), {caption} (orange)"))
    return side_by_side(columns)


def _seen(agent: WorldModelAgent, episode: Episode) -> Tensor:
    """Return the observations of an episode in the units of pictures, `(T + 1, *O)`."""
    observation = map_parts(lambda array: torch.from_numpy(array.copy()), episode.observation)
    return agent.model.likelihood.picture(observation)


def _vectors(likelihood: Likelihood, values: Tensor) -> Tensor | None:
    """Return the numbers of vectors, of several parts those of all, `(T, O)`; None where there are only images."""
    parts = [*likelihood.split(values).values()] if isinstance(likelihood, PartsLikelihood) else [values]
    vectors = [part for part in parts if part.ndim == 2]
    return torch.cat(vectors, -1) if vectors else None


def _to_bytes(frames: torch.Tensor) -> NDArray[np.uint8]:
    """Return images of values in [0, 1] as bytes."""
    return (255 * frames.float().cpu()).round().clamp(0, 255).to(torch.uint8).numpy()
