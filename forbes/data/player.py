"""A process that plays episodes while this one trains."""

import multiprocessing
import pickle
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection

import torch

from forbes.data.collection import MakePolicy, play_whole
from forbes.data.episodes import Episode
from forbes.envs import TIME_LIMIT, Environment, EnvironmentProcess, belong_to_parent
from forbes.errors import ForbesError

__all__ = ["Player"]


class Player:
    """Plays one episode at a time in a process of its own, on the CPU, with one thread.

    The environment lives in a process below that one, as it does below this one without a player. Close it: it does
    not end by itself.

    Args:
        make: makes the environment.
        timeout: see `EnvironmentProcess`.
        time_limit: likewise.
    """

    def __init__(self, make: Callable[[], Environment], timeout: float = 60.0, time_limit: int = TIME_LIMIT) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._connection, theirs = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(theirs, make, timeout, time_limit))
        self._process.start()
        theirs.close()  # so that the end of the process is the end of the pipe

    def begin(self, make_policy: MakePolicy, number: int, seed: int) -> None:
        """Let it play an episode by the policy as it is now.

        Args:
            make_policy: can be pickled.
            number: of the episode, for messages.
            seed: of environment and policy.
        """
        message = pickle.dumps((make_policy, number, seed))  # a pipe's own way to send tensors shares their memory
        with suppress(OSError):  # it has died since the last episode; `finish` says so
            self._connection.send_bytes(message)

    def finish(self) -> Episode:
        """Wait for the episode.

        Raises:
            ForbesError: where it broke three times, or the process has died.
        """
        try:
            answer = self._connection.recv()
        except (EOFError, ConnectionError) as error:
            self._process.join()
            raise ForbesError(
                f"the process that plays episodes has died, exit code {self._process.exitcode}; what it said is above. "
                "Mend that, or set overlap to false"
            ) from error
        if isinstance(answer, ForbesError):
            raise answer
        episode: Episode = answer
        return episode

    def close(self) -> None:
        """End the process, in the midst of an episode too."""
        self._process.kill()
        self._process.join()
        self._connection.close()


def _serve(connection: Connection, make: Callable[[], Environment], timeout: float, time_limit: int) -> None:
    """Run in the process: play what is asked for until the parent is gone."""
    belong_to_parent()
    torch.set_num_threads(1)
    try:
        with EnvironmentProcess(make, timeout, time_limit) as environment:
            while True:
                make_policy, number, seed = connection.recv()
                connection.send(play_whole(environment, make_policy, seed, number))
    except ForbesError as error:
        connection.send(error)
    except EOFError:
        pass
