"""Views: environments that show less than the one they are of. Hidden, blank, occluded, noisy and late observations.

A view changes observations only; rewards and the end of an episode stay as they are. It depends on nothing but the
episode's seed, so an episode can be replayed.

Of an observation of several parts, a view changes all parts, or those that its value names: `{camera: 0.1}`. `Hide` and
`Occlude` need a name.
"""

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step, check_environment
from forbes.envs.parts import OfPart, Part
from forbes.errors import ForbesError
from forbes.reading import is_number
from forbes.shapes import Observed, map_parts, shape_of

__all__ = ["VELOCITIES", "VIEWS", "BlankUntil", "Delay", "Flicker", "Hide", "Noise", "Occlude", "View", "look_through"]

VELOCITIES = "velocities"
"""Name of the part of a vector observation that holds its velocities, see `Environment.named_parts`."""


class View(Environment):
    """An environment of which an agent observes a changed observation, `show(o_t)`.

    Args:
        environment: the environment, which may itself be a view: the innermost is applied first.
        value: what is recorded of it with each episode, a plain value.
    """

    option: ClassVar[str]
    """Its name in a configuration and in the record of an episode."""

    def __init__(self, environment: Environment, value: Any) -> None:
        self.environment, self.value = environment, value
        self.observation_shape, self.action_dim = shape_of(environment.observation_shape), environment.action_dim
        self.discrete, self.action_repeat = environment.discrete, environment.action_repeat

    @abstractmethod
    def show(self, observation: Observed) -> Observed:
        """Return what is observed in place of o_t, in the same dtype. Called once a step."""

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed, with random numbers that depend on the seed and the kind of view only."""
        part = self.environment.part if isinstance(self.environment, Part) else ""
        self._random, self._steps = np.random.default_rng([seed, *f"{self.option}{part}".encode()]), 0
        return self._shown(self.environment.reset(seed))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`."""
        self._steps += 1
        return self._shown(self.environment.step(action))

    def _shown(self, step: Step) -> Step:
        return step._replace(observation=self.show(step.observation))

    def named_parts(self) -> dict[str, list[int]]:
        """See `Environment.named_parts`."""
        return self.environment.named_parts()

    def describe(self) -> dict[str, Any]:
        """Return the environment's description with `views`, in the order in which they are applied."""
        described = self.environment.describe()
        return described | {"views": [*described.get("views", []), {self.option: self.value}]}

    def _array_shape(self) -> tuple[int, ...]:
        """Return the shape of observations of one array. Of several parts, one must be named."""
        if isinstance(shape := self.observation_shape, Mapping):
            example = f"{{{next(iter(shape))}: {self.value!r}}}"
            self._require(False, f"its value for one of the parts {', '.join(shape)}, e.g. {example}")
        return shape_of(shape)  # type: ignore[return-value]

    def _require(self, valid: bool, expected: str) -> None:
        if not valid:
            task = self.environment.describe()["task"]
            raise ForbesError(f"{task}: {self.option} is {self.value!r}, expected {expected}. Change it")


class Hide(View):
    r"""Leave out dimensions of a vector observation, so that :math:`o'_t = (o_{t,i})_{i \notin I}`.

    Args:
        environment: environment that shows vectors.
        parts: names of `Environment.named_parts`, e.g. `velocities`, or indices from 0; one of them, or a list.

    Raises:
        ForbesError: if there is no such part, nothing or all would be hidden, or the observations are images.
    """

    option = "hide"

    def __init__(self, environment: Environment, parts: str | int | Sequence[str | int]) -> None:
        super().__init__(environment, parts)
        shape = self._array_shape()
        self._require(len(shape) == 1, "vectors to hide parts of, not images. `occlude` hides pixels")
        (size,), named = shape, environment.named_parts()
        wanted = [parts] if isinstance(parts, str | int) else list(parts)
        hidden: set[int] = set()
        for part in wanted:
            by_index = [part] if type(part) is int and 0 <= part < size else []
            indices = named.get(part, []) if isinstance(part, str) else by_index
            names = f"one of {', '.join(named)}, or " if named else ""
            self._require(len(indices) > 0, f"{names}an index from 0 to {size - 1}")
            hidden.update(indices)
        self._require(0 < len(hidden) < size, f"at least one of the {size} dimensions, and not all of them")
        self.value = sorted(hidden)
        self._kept = [index for index in range(size) if index not in hidden]
        self.observation_shape = (len(self._kept),)

    def show(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Return the dimensions that are not hidden, `(O',)`."""
        return observation[self._kept]

    def named_parts(self) -> dict[str, list[int]]:
        """See `Environment.named_parts`; indices are those of what is shown."""
        place = {index: number for number, index in enumerate(self._kept)}
        parts = {name: [place[i] for i in part if i in place] for name, part in super().named_parts().items()}
        return {name: part for name, part in parts.items() if part}


class Flicker(View):
    r"""Show zeros with probability p at each step (Hausknecht and Stone, 2015, arXiv 1507.06527).

    .. math:: o'_t = b_t\, o_t, \qquad b_t \sim \mathrm{Bernoulli}(1 - p)

    Args:
        environment: environment that shows images or vectors.
        probability: p in [0, 1].
    """

    option = "flicker"

    def __init__(self, environment: Environment, probability: float) -> None:
        super().__init__(environment, probability)
        self._require(is_number(probability) and 0 <= probability <= 1, "a probability in [0, 1]")

    def show(self, observation: Observed) -> Observed:
        """Return o_t, or zeros."""
        return _blank(observation) if self._random.random() < self.value else observation


class Occlude(View):
    """Blank a box of every image.

    Args:
        environment: environment that shows images.
        box: left, top, right and bottom as fractions of width and height in [0, 1]; each edge is rounded to a pixel.

    Raises:
        ForbesError: if the box holds no pixel, or the observations are vectors.
    """

    option = "occlude"

    def __init__(self, environment: Environment, box: Sequence[float]) -> None:
        super().__init__(environment, box)
        shape = self._array_shape()
        self._require(len(shape) == 3, "images to occlude, not vectors. `hide` leaves out dimensions")
        numbers = isinstance(box, list | tuple) and len(box) == 4 and all(is_number(x) and 0 <= x <= 1 for x in box)
        self._require(numbers, "left, top, right and bottom as fractions in [0, 1]")
        self.value, (_, height, width) = list(box), shape
        left, top, right, bottom = (
            round(x * side) for x, side in zip(box, (width, height, width, height), strict=True)
        )
        self._require(left < right and top < bottom, f"a box of at least one of the {width} x {height} pixels")
        self._box = slice(None), slice(top, bottom), slice(left, right)

    def show(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Return the image with a black box, `(C, H, W)`."""
        shown = observation.copy()
        shown[self._box] = 0
        return shown


class Noise(View):
    r"""Add noise, independent in every dimension or pixel and at every step.

    .. math:: o'_t = o_t + \sigma \epsilon_t, \qquad \epsilon_t \sim N(0, I)

    An image is rounded and clipped to 0 … 255 afterwards.

    Args:
        environment: environment that shows images or vectors.
        std: :math:`\sigma`, in units of the observation; for images as a fraction of their range, so that 0.1 is
            25.5 grey levels.
    """

    option = "noise"

    def __init__(self, environment: Environment, std: float) -> None:
        super().__init__(environment, std)
        self._require(is_number(std) and 0 <= std < np.inf, "a standard deviation of at least 0")

    def show(self, observation: Observed) -> Observed:
        """Return the noisy observation."""
        return map_parts(self._noisy, observation)

    def _noisy(self, observation: NDArray[Any]) -> NDArray[Any]:
        noise: NDArray[np.float64] = self.value * self._random.standard_normal(observation.shape)
        if observation.ndim == 1:
            return (observation + noise).astype(np.float32)
        return (observation + 255 * noise).round().clip(0, 255).astype(np.uint8)


class Delay(View):
    r"""Show every observation k steps late: :math:`o'_t = o_{t-k}`, and zeros before the first one has arrived.

    Args:
        environment: environment that shows images or vectors.
        steps: agent steps of delay, k.
    """

    option = "delay"

    def __init__(self, environment: Environment, steps: int) -> None:
        super().__init__(environment, steps)
        self._require(type(steps) is int and steps >= 0, "a number of agent steps, at least 0")
        self._late: deque[Observed] = deque(maxlen=steps + 1)

    def show(self, observation: Observed) -> Observed:
        """Return o_{t-k}."""
        if self._steps == 0:
            self._late.extend([_blank(observation)] * self.value)
        self._late.append(map_parts(np.copy, observation))  # it may be a buffer of the environment
        return self._late[0]


class BlankUntil(View):
    """Show zeros for the first observations of an episode.

    Args:
        environment: environment that shows images or vectors.
        steps: agent steps before the first that is shown, so this number of observations is blank.
    """

    option = "blank_until"

    def __init__(self, environment: Environment, steps: int) -> None:
        super().__init__(environment, steps)
        self._require(type(steps) is int and steps >= 0, "a number of agent steps, at least 0")

    def show(self, observation: Observed) -> Observed:
        """Return zeros, then o_t."""
        return _blank(observation) if self._steps < self.value else observation


def _blank(observation: Observed) -> Observed:
    return map_parts(np.zeros_like, observation)


VIEWS: dict[str, Callable[[Environment, Any], View]] = {
    kind.option: kind for kind in (Hide, Flicker, Occlude, Noise, Delay, BlankUntil)
}
"""Views by their name in the options of a task."""


def without_views(make: Callable[..., Environment]) -> Callable[..., Environment]:
    """Return the function that makes an environment without its views."""
    while isinstance(make, partial) and make.func is look_through:
        make = make.args[0]
    return make


def look_through(make: Callable[[], Environment], views: dict[str, Any]) -> Environment:
    """Make an environment, and look at it through views: the first of them is applied first."""
    environment = make()
    check_environment(environment)
    for option, value in views.items():
        if isinstance(environment.observation_shape, Mapping) and isinstance(value, Mapping):
            for part, of_part in value.items():
                environment = OfPart(environment, VIEWS[option], part, of_part)
        else:
            environment = VIEWS[option](environment, value)
    return environment
