"""A process that plays episodes while this one trains."""

import atexit
import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection

import torch

from forbes.child import start_child
from forbes.data.episodes.collection import ATTEMPTS, MakePolicy, play_whole
from forbes.data.episodes.episode import Episode
from forbes.envs import TIME_LIMIT, Environment, EnvironmentProcess
from forbes.errors import ForbesError

__all__ = ["EpisodeWorker"]


class EpisodeWorker:
    """Plays one episode at a time in a process of its own, on the CPU, with one thread.

    The environment lives in a process below that one, as it does below this one without a player. A process that dies
    is started again, and plays its episode again. Close it: it does not end before this process does.

    Args:
        make: makes the environment.
        timeout: see `EnvironmentProcess`.
        time_limit: likewise.
    """

    def __init__(self, make: Callable[[], Environment], timeout: float = 60.0, time_limit: int = TIME_LIMIT) -> None:
        self._arguments = make, timeout, time_limit
        self._start()
        atexit.register(self.close)  # multiprocessing would wait for it

    def begin(self, make_policy: MakePolicy, number: int, seed: int) -> None:
        """Let it play an episode by the policy as it is now.

        Args:
            make_policy: can be pickled.
            number: of the episode, for messages.
            seed: of environment and policy.
        """
        self._number = number
        self._message = pickle.dumps((make_policy, number, seed))  # a pipe's own way shares the memory of tensors
        self._ask()

    def finish(self, attempts: int = ATTEMPTS) -> Episode:
        """Wait for the episode.

        Raises:
            ForbesError: where the episode broke, or the process died, three times.
        """
        try:
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            self._process.join()
            died = f"the process that plays episodes has died, exit code {self._process.exitcode}"
            if attempts == 1:
                raise ForbesError(
                    f"{died}, {ATTEMPTS} times in episode {self._number}; what it said is above. Mend that, or set "
                    "overlap to false"
                ) from error
            print(f"forbes: {died}; episode {self._number} is played again", file=sys.stderr)
        else:
            if isinstance(answer, ForbesError):
                raise answer
            episode: Episode = answer
            return episode
        self._connection.close()
        self._start()
        self._ask()
        return self.finish(attempts - 1)

    def close(self) -> None:
        """End the process, in the midst of an episode too."""
        self._process.kill()
        self._process.join()
        self._connection.close()
        atexit.unregister(self.close)

    def _start(self) -> None:
        self._process, self._connection = start_child(_serve, *self._arguments)

    def _ask(self) -> None:
        with suppress(OSError):  # it has died since the last episode, which `finish` finds
            self._connection.send_bytes(self._message)


def _serve(connection: Connection, make: Callable[[], Environment], timeout: float, time_limit: int) -> None:
    """Run in the process: play what is asked for until the parent is gone."""
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
