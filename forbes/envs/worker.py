"""Run an environment in a worker process, so that a simulator that hangs, dies or raises does not affect the parent.

A renderer in a process that trains on a GPU can hang it. The worker exchanges numpy arrays and does not import torch,
unless the environment does.
"""

import atexit
import inspect
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
from forbes.envs.views import without_views
from forbes.errors import ForbesError
from forbes.factors import Discrete
from forbes.shapes import Shape, shape_of

__all__ = ["BrokenEnvironmentError", "EnvironmentProcess"]

START_LIMIT = 180.0
"""Timeout in seconds to import and build an environment, including two probes of a renderer, 60 s each."""
_UNGUARDED = '. The process re-imports the script that started it: guard its code with `if __name__ == "__main__":`'


_IN_A_MODULE = "Define it at the top level of a module file, and import it from there"


class BrokenEnvironmentError(ForbesError):
    """An environment hung, died, raised an error or returned invalid values. Its episode is lost; a reset may help."""


class _Facts(NamedTuple):
    """Attributes of the environment, sent by the worker once it is built."""

    observation_shape: Shape
    action_dim: int
    discrete: Discrete
    action_repeat: int
    description: dict[str, Any]


class _Report(NamedTuple):
    """Error sent by the worker before it exits."""

    sentence: str
    details: str
    refused: bool
    """True for an error that the user must fix, so that there is no point in trying again."""


class EnvironmentProcess(Environment):
    """An environment in a worker process, which is restarted for the reset after a failure.

    Close it, or use it in a `with` statement. The worker always ends with its parent.

    Args:
        make: function that makes the environment: the result of `find_environment`, a class, or a `functools.partial`.
        timeout: seconds within which a reset or step must be answered.
        time_limit: number of steps after which an episode is truncated.

    Raises:
        BrokenEnvironmentError: if the environment cannot be built.
        ForbesError: if the environment raises one when it is built, or `make` cannot be sent to another process.
    """

    def __init__(self, make: Callable[[], Environment], timeout: float = 60.0, time_limit: int = TIME_LIMIT) -> None:
        _require_importable(make)
        self.make, self.timeout, self.time_limit = make, timeout, time_limit
        self._process: BaseProcess | None = None
        self._start()

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed. Raises a BrokenEnvironmentError on a failure."""
        if self._process is None:
            self._start()
        self._steps = 0
        return self._ask("reset", seed)

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`. Raises a BrokenEnvironmentError on a failure; then call `reset`."""
        if self._process is None:
            raise BrokenEnvironmentError(f"{self._name}: the episode failed, expected a reset before the next step")
        step = self._ask("step", action)
        self._steps += 1
        if self._steps >= self.time_limit and not step.terminated:
            return step._replace(truncated=True)
        return step

    def describe(self) -> dict[str, Any]:
        """Return the environment's description with the time limit that applies: its own, or the environment's."""
        own = self._description.get("time_limit", self.time_limit)
        return self._description | {"time_limit": min(own, self.time_limit)}

    def close(self) -> None:
        """Kill the process."""
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
        """Name for error messages: the task, or of a class without an argument of this name, the class."""
        if hasattr(self, "_description"):
            return str(self._description["task"])
        make = without_views(self.make)
        kind, arguments = getattr(make, "func", make), getattr(make, "args", ())
        return str(arguments[0]) if arguments and "task" in inspect.signature(kind).parameters else str(kind.__name__)

    def _start(self) -> None:
        self._process, self._connection = start_child(_serve, self.make)
        atexit.register(self.close)  # multiprocessing would wait for the process
        facts: _Facts = self._receive("start", START_LIMIT)
        self.observation_shape, self.action_dim, self.discrete, self.action_repeat, self._description = facts

    def _ask(self, method: str, argument: Any) -> Step:
        try:
            self._connection.send((method, argument))
        except OSError:  # the process has died; the pipe may still contain its error, which `_receive` reads
            pass
        step: Step = self._receive(method, self.timeout)
        return step

    def _receive(self, method: str, timeout: float) -> Any:
        """Wait for an answer; on any error, end the process."""
        try:
            return self._answer(method, timeout)
        except BaseException:  # also after an interrupt, whose pending answer would be mistaken for the next one
            self.close()
            raise

    def _answer(self, method: str, timeout: float) -> Any:
        assert self._process is not None
        try:
            if not self._connection.poll(timeout):
                raise BrokenEnvironmentError(f"{self._name}: it hangs, no answer to {method} within {timeout:g} s")
            answer = self._connection.recv()
        except (EOFError, OSError) as error:  # before or within an answer
            self._process.join(timeout)
            status = self._process.exitcode
            raise BrokenEnvironmentError(
                f"{self._name}: its process died in {method}, exit code {status}"
                + (_UNGUARDED if method == "start" else "")
            ) from error
        if isinstance(answer, _Report):
            kind = ForbesError if answer.refused else BrokenEnvironmentError
            raised = kind(answer.sentence if answer.refused else f"{self._name}: {method} raises {answer.sentence}")
            raised.add_note(answer.details)
            raise raised
        return answer


class _Importable(pickle.Pickler):
    """Refuses classes and functions of a `__main__` without a file, which another process could not import."""

    def reducer_override(self, value: Any) -> Any:
        """Raise a ForbesError for such a class or function; leave everything else to pickle."""
        if isinstance(value, type | FunctionType) and value.__module__ == "__main__":
            raise ForbesError(
                f"{value.__qualname__}: it is defined in a notebook or on standard input, which the worker process of "
                f"an environment cannot import. {_IN_A_MODULE}"
            )
        return NotImplemented


def _require_importable(make: Callable[[], Environment]) -> None:
    """Raise a ForbesError if `make` cannot be sent to another process."""
    name = getattr(make, "__qualname__", type(make).__name__)
    file = getattr(sys.modules["__main__"], "__file__", "")
    try:
        (pickle.Pickler if os.path.isfile(file) else _Importable)(io.BytesIO()).dump(make)
    except (pickle.PicklingError, AttributeError, TypeError) as error:  # pickle raises any of these
        raise ForbesError(f"{name}: it cannot be sent to another process ({error}). {_IN_A_MODULE}") from error
    if file and not os.path.isfile(file):  # "<stdin>", which a spawned process treats as a file
        raise ForbesError(
            f"{name}: code on standard input cannot start the worker process of an environment, which re-imports it. "
            "Write it to a file"
        )


def _serve(connection: Connection, make: Callable[[], Environment]) -> None:
    """Main function of the worker: build the environment and answer until the parent exits or an error occurs."""
    try:
        environment = make()
        check_environment(environment)
        shape = shape_of(environment.observation_shape)
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
