"""A worker process that plays episodes while this process trains, or several that play them at the same time."""

import atexit
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from itertools import cycle
from multiprocessing.connection import Connection

import torch

from forbes.child import start_child
from forbes.data.episodes.collection import ATTEMPTS, MakePolicy, describe_environment, episode_seed, play_whole
from forbes.data.episodes.episode import Episode, EpisodeRecord
from forbes.data.episodes.store import EpisodeWriter
from forbes.envs import TIME_LIMIT, Environment, EnvironmentProcess
from forbes.errors import ForbesError

__all__ = ["EpisodeWorker", "collect_in_parallel"]


class EpisodeWorker:
    """Plays one episode at a time in a separate process, on the CPU, with one thread.

    The environment has its own process, a child of the worker's. A worker process that dies is restarted and replays
    its episode. Call `close` at the end.

    Args:
        make: function that makes the environment; must be picklable.
        timeout: seconds within which the environment must answer.
        time_limit: number of steps after which an episode is truncated.
    """

    def __init__(self, make: Callable[[], Environment], timeout: float = 60.0, time_limit: int = TIME_LIMIT) -> None:
        self._arguments = make, timeout, time_limit
        self._start()
        atexit.register(self.close)  # multiprocessing would wait for the process

    def begin(self, make_policy: MakePolicy, number: int, seed: int) -> None:
        """Start an episode with the current weights of the policy.

        Args:
            make_policy: function that makes the policy; must be picklable.
            number: number of the episode, for messages.
            seed: random seed for environment and policy.
        """
        self._number = number
        self._message = pickle.dumps((make_policy, number, seed))  # Connection.send would share the tensors' memory
        self._ask()

    def finish(self, attempts: int = ATTEMPTS) -> Episode:
        """Wait for the episode and return it.

        Raises:
            ForbesError: if the episode fails, or the process dies, three times.
        """
        try:
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            self._process.join()
            died = f"the process that plays episodes died, exit code {self._process.exitcode}"
            if attempts == 1:
                raise ForbesError(
                    f"{died}, {ATTEMPTS} times in episode {self._number}. Fix the error printed above, or set overlap "
                    "to false"
                ) from error
            print(f"forbes: {died}; episode {self._number} is replayed", file=sys.stderr)
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
        """End the process, even during an episode."""
        self._process.kill()
        self._process.join()
        self._connection.close()
        atexit.unregister(self.close)

    def _start(self) -> None:
        self._process, self._connection = start_child(_serve, *self._arguments)

    def _ask(self) -> None:
        with suppress(OSError):  # the process may have died since the last episode, which `finish` handles
            self._connection.send_bytes(self._message)


def collect_in_parallel(
    number: int,
    environment: EnvironmentProcess,
    writer: EpisodeWriter,
    make_policy: MakePolicy,
    policy: str,
    until: int,
    seed: int,
) -> Iterator[EpisodeRecord]:
    """Play several episodes at the same time, and store the same ones in the same order as `collect_episodes`.

    Args:
        number: number of processes that play.
        environment: environment like those to play in, for the record.
        writer: episode store to write to.
        make_policy: function that makes the policy of an episode; must be picklable.
        policy: name of the policy, for the record.
        until: number of episodes that the store shall have had, its watermark.
        seed: random seed for the episodes and their policies.

    Yields:
        Record of each episode, once it is safely stored.

    Raises:
        ForbesError: if an episode or its process fails three times, or cannot be stored.
    """
    numbers = range(writer.watermark, until)
    with ExitStack() as stack:
        workers = [
            stack.enter_context(closing(EpisodeWorker(environment.make, environment.timeout, environment.time_limit)))
            for _ in numbers[:number]
        ]
        for episode, worker in zip(numbers, workers, strict=False):
            worker.begin(make_policy, episode, episode_seed(seed, episode))
        for episode, worker in zip(numbers, cycle(workers), strict=False):
            yield writer.append(worker.finish(), episode_seed(seed, episode), policy, describe_environment(environment))
            if (later := episode + len(workers)) < until:
                worker.begin(make_policy, later, episode_seed(seed, later))


def _serve(connection: Connection, make: Callable[[], Environment], timeout: float, time_limit: int) -> None:
    """Main function of the process: play the requested episodes until the parent exits."""
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
