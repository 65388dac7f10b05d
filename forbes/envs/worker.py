"""A process that owns an environment, so that a simulator that hangs, dies or raises takes nothing with it.

A renderer in the process that trains on a GPU can hang it. Numbers travel as numpy, and torch is not imported there
unless the environment does it.
"""

import atexit
import io
import os
import pickle
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import FunctionType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from forbes.child import start_child
from forbes.envs.base import TIME_LIMIT, Environment, Step, check_environment, check_step
from forbes.errors import ForbesError

__all__ = ["BrokenEnvironmentError", "EnvironmentProcess"]

START_LIMIT = 180.0
"""Seconds to import and build an environment; two tries of a renderer, of 60 each, among them."""
_UNGUARDED = '. It reads the script that started it anew: keep its commands under `if __name__ == "__main__":`'


_IN_A_MODULE = "Define it at the top of a module file, and import it from there"


class BrokenEnvironmentError(ForbesError):
    """An environment has hung, died, raised or given what is no number: its episode is lost, the next may go well."""


class _Facts(NamedTuple):
    """What the process says of its environment once it is built."""

    observation_shape: tuple[int, ...]
    action_dim: int
    discrete: bool
    action_repeat: int
    description: dict[str, Any]


class _Report(NamedTuple):
    """What the process says before it ends."""

    sentence: str
    details: str
    refused: bool
    """True for an error the user can mend: to try again is no use."""


class EnvironmentProcess(Environment):
    """An environment in a process of its own, which is started anew for the reset that follows a failure.

    Close it, or use it in a `with` statement. The process ends with its parent, whatever ends that.

    Args:
        make: makes the environment; what `find_environment` gives, a class, or a `functools.partial` of one.
        timeout: seconds in which a reset or a step must be answered.
        time_limit: steps after which an episode that has not ended by itself is truncated, so that each has an end.

    Raises:
        BrokenEnvironmentError: where the environment cannot be built.
        ForbesError: where it says why, in a sentence, or another process cannot import what makes it.
    """

    def __init__(self, make: Callable[[], Environment], timeout: float = 60.0, time_limit: int = TIME_LIMIT) -> None:
        _require_importable(make)
        self.make, self._timeout, self._time_limit = make, timeout, time_limit
        self._process: BaseProcess | None = None
        self._start()

    def reset(self, seed: int) -> Step:
        """See `Environment.reset`; raises BrokenEnvironmentError."""
        if self._process is None:
            self._start()
        self._steps = 0
        return self._ask("reset", seed)

    def step(self, action: NDArray[np.float32]) -> Step:
        """See `Environment.step`; raises BrokenEnvironmentError, after which there must be a reset."""
        if self._process is None:
            raise BrokenEnvironmentError(f"{self._name}: the episode is broken, expected a reset before the next step")
        step = self._ask("step", action)
        self._steps += 1
        if self._steps >= self._time_limit and not step.terminated:
            return step._replace(truncated=True)
        return step

    def describe(self) -> dict[str, Any]:
        """See `Environment.describe`; with the limit of steps, its own or the environment's, whichever comes first."""
        own = self._description.get("time_limit", self._time_limit)
        return self._description | {"time_limit": min(own, self._time_limit)}

    def close(self) -> None:
        """End the process, however busy it is."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
            self._process = None
            atexit.unregister(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _name(self) -> str:
        """What errors call it: its task or, until it is built, what builds it."""
        built = hasattr(self, "_description")
        return str(self._description["task"] if built else getattr(self.make, "func", self.make).__name__)

    def _start(self) -> None:
        self._process, self._connection = start_child(_serve, self.make)
        atexit.register(self.close)  # multiprocessing would wait for it
        facts: _Facts = self._receive("start", START_LIMIT)
        self.observation_shape, self.action_dim, self.discrete, self.action_repeat, self._description = facts

    def _ask(self, method: str, argument: Any) -> Step:
        try:
            self._connection.send((method, argument))
        except OSError:  # it has died since its last answer; the pipe still holds why, if it could say so
            pass
        step: Step = self._receive(method, self._timeout)
        return step

    def _receive(self, method: str, timeout: float) -> Any:
        """Wait for an answer; whatever comes instead ends the process."""
        try:
            return self._answer(method, timeout)
        except BaseException:  # an interrupt, too: the answer it left would be taken for the next one's
            self.close()
            raise

    def _answer(self, method: str, timeout: float) -> Any:
        assert self._process is not None
        try:
            if not self._connection.poll(timeout):
                raise BrokenEnvironmentError(f"{self._name}: it hangs, no answer to {method} within {timeout:g} s")
            answer = self._connection.recv()
        except (EOFError, OSError) as error:  # before an answer, or within one
            self._process.join(timeout)
            status = self._process.exitcode
            raise BrokenEnvironmentError(
                f"{self._name}: its process has died in {method}, exit code {status}"
                + (_UNGUARDED if method == "start" else "")
            ) from error
        if isinstance(answer, _Report):
            kind = ForbesError if answer.refused else BrokenEnvironmentError
            raised = kind(answer.sentence if answer.refused else f"{self._name}: {method} raises {answer.sentence}")
            raised.add_note(answer.details)
            raise raised
        return answer


class _Importable(pickle.Pickler):
    """Finds what another process could not import: the classes and functions of a `__main__` without a file."""

    def reducer_override(self, value: Any) -> Any:
        """Raise a ForbesError for one of them; leave all else to pickle."""
        if isinstance(value, type | FunctionType) and value.__module__ == "__main__":
            raise ForbesError(
                f"{value.__qualname__}: it is defined in a notebook or on standard input, which the process of an "
                f"environment cannot import. {_IN_A_MODULE}"
            )
        return NotImplemented


def _require_importable(make: Callable[[], Environment]) -> None:
    """Raise a ForbesError where what makes an environment cannot be sent to another process."""
    name = getattr(make, "__qualname__", type(make).__name__)
    file = getattr(sys.modules["__main__"], "__file__", "")
    try:
        (pickle.Pickler if os.path.isfile(file) else _Importable)(io.BytesIO()).dump(make)
    except (pickle.PicklingError, AttributeError, TypeError) as error:  # all three are what pickle raises
        raise ForbesError(f"{name}: it cannot be sent to another process ({error}). {_IN_A_MODULE}") from error
    if file and not os.path.isfile(file):  # "<stdin>", which a spawned process takes for a file
        raise ForbesError(
            f"{name}: commands on standard input cannot start the process of an environment, which reads them again. "
            "Write them to a file"
        )


def _serve(connection: Connection, make: Callable[[], Environment]) -> None:
    """Run in the process: build the environment and answer until the parent is gone or something is wrong."""
    try:
        environment = make()
        check_environment(environment)
        shape = tuple(environment.observation_shape)
        numbers = (environment.action_dim, environment.discrete, environment.action_repeat)
        connection.send(_Facts(shape, *numbers, environment.describe()))
        while True:
            method, argument = connection.recv()
            step: Step = getattr(environment, method)(argument)
            check_step(step, shape)
            connection.send(step)
    except (EOFError, ConnectionError):
        pass
    except Exception as error:
        refused = isinstance(error, ForbesError)
        sentence = str(error) if refused else f"{type(error).__name__}: {error}"
        connection.send(_Report(" ".join(sentence.split()), traceback.format_exc(), refused))
