"""One part of an observation of several, and environments of which one part is seen through a view."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step
from forbes.errors import ForbesError
from forbes.shapes import Shape, shape_of

__all__ = ["OfPart", "Part", "only_vector"]


class Part(Environment):
    """One part of an environment's observations, as the environment that a view changes."""

    def __init__(self, environment: Environment, part: str) -> None:
        self.environment, self.part = environment, part
        shapes = environment.observation_shape
        self.observation_shape, self.action_dim = dict(shapes)[part], environment.action_dim  # type: ignore[arg-type]

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed."""
        return self._seen(self.environment.reset(seed))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action."""
        return self._seen(self.environment.step(action))

    def _seen(self, step: Step) -> Step:
        self.whole = step
        return step._replace(observation=step.observation[self.part])

    def named_parts(self) -> dict[str, list[int]]:
        """See `Environment.named_parts`, where this is the only vector."""
        return self.environment.named_parts() if only_vector(self.environment.observation_shape) == self.part else {}

    def describe(self) -> dict[str, Any]:
        """Return the environment's description."""
        return self.environment.describe()


class OfPart(Environment):
    """An environment of which one part of the observations is seen through a view.

    Args:
        environment: environment that shows several parts.
        make_view: the view, a function of an environment and a value.
        part: name of the part.
        value: value of the view.

    Raises:
        ForbesError: if there is no such part, or the view refuses it.
    """

    def __init__(
        self, environment: Environment, make_view: Callable[[Environment, Any], Any], part: str, value: Any
    ) -> None:
        if part not in (shapes := environment.observation_shape):
            raise ForbesError(
                f"{environment.describe()['task']}: a view names the part {part}, expected one of "
                f"{', '.join(sorted(map(str, shapes)))}. Change it"
            )
        self.environment, self.part = environment, Part(environment, part)
        self.view = make_view(self.part, value)
        shown = self.view.observation_shape
        self.observation_shape = shape_of({**environment.observation_shape, part: shown})  # type: ignore[dict-item]
        self.action_dim, self.discrete = environment.action_dim, environment.discrete
        self.action_repeat = environment.action_repeat

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed."""
        return self._shown(self.view.reset(seed))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`."""
        return self._shown(self.view.step(action))

    def _shown(self, step: Step) -> Step:
        whole = self.part.whole
        return whole._replace(observation=whole.observation | {self.part.part: step.observation})

    def named_parts(self) -> dict[str, list[int]]:
        """See `Environment.named_parts`."""
        only = only_vector(self.observation_shape)
        return (self.view if only == self.part.part else self.environment).named_parts()

    def describe(self) -> dict[str, Any]:
        """Return the environment's description with `views`, in the order in which they are applied."""
        described = self.environment.describe()
        of_part = {self.view.option: {self.part.part: self.view.value}}
        return described | {"views": [*described.get("views", []), of_part]}


def only_vector(shape: Shape) -> str | None:
    """Return the name of the part that is a vector, if there is only one."""
    vectors = [name for name, one in shape.items() if len(one) == 1] if isinstance(shape, Mapping) else []
    return vectors[0] if len(vectors) == 1 else None
