"""Memory Maze (Pasukonis et al., 2022, arXiv 2210.13383): find again what was seen before, seen from inside."""

from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step
from forbes.envs.dm_control import environment_variable
from forbes.envs.images import to_image
from forbes.envs.rendering import choose_backend
from forbes.errors import ForbesError

__all__ = ["SIZES", "MemoryMaze"]

SIZES = ("9x9", "11x11", "13x13", "15x15")


class MemoryMaze(Environment):
    """A maze of the package memory-maze, as images of 64 x 64 pixels whose border has the colour of the object to find.

    Six actions, one-hot: none, forward, left, right, forward and left, forward and right. The reward is 1 for the
    object of that colour; then the colour changes. Episodes are truncated after 1,000 to 4,000 steps.

    Maze and objects are drawn once per episode from its seed, so the simulator is built for every reset, which takes
    seconds.

    Args:
        size: 9x9, 11x11, 13x13 or 15x15.
        backend: OpenGL backend that is known to render. Default: the one of `choose_backend`.

    Raises:
        ForbesError: for another size, if memory-maze is not installed, or if no backend renders.
    """

    observation_shape, action_dim, discrete = (3, 64, 64), 6, True

    def __init__(self, size: str, backend: str | None = None) -> None:
        if size not in SIZES:
            raise ForbesError(f"memory_maze: size is {size}, expected {', '.join(SIZES)}. Choose one")
        self.size, self.backend = size, backend or choose_backend().backend
        self._make = _load(size, self.backend)
        self._environment: Any = None

    def reset(self, seed: int) -> Step:
        """Build the maze of a seed, and start the episode."""
        if self._environment is not None:
            self._environment.close()
        self._environment = self._make(seed=seed, image_only_obs=True)
        return Step(to_image(self._environment.reset().observation))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(6,)`, one-hot."""
        last = self._environment.step(int(action.argmax()))
        ends = last.last()
        return Step(
            to_image(last.observation), float(last.reward), ends and last.discount == 0, ends and last.discount != 0
        )

    def describe(self) -> dict[str, Any]:
        """Return task, renderer and versions."""
        made_by = {name: version(name) for name in ("memory-maze", "dm-control", "mujoco")} | {"backend": self.backend}
        return {"task": f"memory_maze_{self.size}", "made_by": made_by}


def _load(size: str, backend: str) -> Any:
    """Return the function that makes an environment of this size."""
    try:
        with environment_variable("MUJOCO_GL", backend):  # read at the first import
            from memory_maze import tasks
    except ImportError as error:
        raise ForbesError(f"memory_maze_{size}: {error}. pip install 'forbes[memory-maze]'") from error
    return getattr(tasks, f"memory_maze_{size}")
