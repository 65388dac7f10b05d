"""Film an episode of an agent that does not observe images: play it again in front of a camera."""

import inspect
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.collection import play
from forbes.data.episodes.episode import Episode
from forbes.envs import Environment, EnvironmentProcess
from forbes.envs.views import without_views
from forbes.errors import ForbesError

__all__ = ["camera_of", "film"]

_SIDE = 256  # pixels


def camera_of(make: Callable[..., Environment]) -> Callable[[], Environment] | None:
    """Return a function that makes the same environment without views and with `pixels`, or None if it has none."""
    make = without_views(make)
    options = inspect.signature(make).parameters
    if "pixels" not in options:
        return None
    return partial(make, pixels=True, **({"size": _SIDE} if "size" in options else {}))


def film(camera: EnvironmentProcess, episode: Episode, seed: int) -> NDArray[np.uint8]:
    """Return the images of an episode, uint8 `(T + 1, C, H, W)`.

    Args:
        camera: the environment of the episode as `camera_of` makes it, with T as its time limit.
        episode: an episode of T actions.
        seed: seed with which the environment was reset.

    Raises:
        ForbesError: if the episode is another one in front of the camera.
    """
    actions = iter(episode.action[1:])
    filmed = play(camera, lambda _: next(actions), seed)
    if not np.array_equal(filmed.reward, episode.reward):
        raise ForbesError(
            f"{camera.describe()['task']}: the same seed and actions earn other rewards with pixels than without, "
            "expected the same episode. Make its rewards independent of pixels"
        )
    images: NDArray[np.uint8] = filmed.observation
    return images
