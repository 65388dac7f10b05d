"""Play episodes: an environment, a policy and a seed determine an `Episode`."""

import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode, EpisodeRecord
from forbes.data.episodes.store import EpisodeWriter
from forbes.envs import BrokenEnvironmentError, Environment, Step
from forbes.errors import ForbesError
from forbes.factors import as_plain, factor_sizes, to_one_hot
from forbes.seeding import derive_seed
from forbes.shapes import Observed, map_parts, plain_shape

__all__ = [
    "ATTEMPTS",
    "EpisodePolicy",
    "MakePolicy",
    "collect_episodes",
    "describe_environment",
    "episode_seed",
    "play",
    "play_whole",
    "random_policy",
]

EpisodePolicy: TypeAlias = Callable[[Observed], NDArray[np.float32]]
"""Function that chooses a_t, float32 `(A,)`, given o_t. It is used for one episode only and may have a memory."""
MakePolicy: TypeAlias = Callable[[Environment, int], EpisodePolicy]
"""Function that makes the policy of an episode from the environment and a random seed."""

ATTEMPTS = 3
"""Maximal number of attempts to play an episode."""


def random_policy(environment: Environment, seed: int) -> EpisodePolicy:
    """Make a policy with independent uniform actions, in [-1, 1]^A or with uniform choices, one-hot."""
    random, count = np.random.default_rng(seed), environment.action_dim
    if sizes := factor_sizes(environment.discrete, count):
        return lambda _: to_one_hot(np.array([random.integers(size) for size in sizes]), sizes)
    return lambda _: random.uniform(-1, 1, count).astype(np.float32)


def play(environment: Environment, policy: EpisodePolicy, seed: int) -> Episode:
    """Play one episode from its reset to its end.

    Raises:
        BrokenEnvironmentError: if the process of the environment fails.
        ForbesError: if the policy returns an invalid action.
    """
    step = environment.reset(seed)
    steps: list[Step] = [step]
    actions = [np.zeros(environment.action_dim, np.float32)]
    while not (step.terminated or step.truncated):
        action = policy(step.observation)
        if action.shape != actions[0].shape or not np.isfinite(action).all():
            raise ForbesError(
                f"{environment.describe()['task']}: the policy's action at step {len(steps) - 1} is {action}, "
                f"expected {environment.action_dim} finite numbers. Fix the policy"
            )
        step = environment.step(action)
        steps.append(step)
        actions.append(action)
    return Episode(
        observation=map_parts(_stacked, *(step.observation for step in steps)),  # (T + 1, ...)
        action=np.stack(actions),  # (T + 1, A)
        reward=np.array([0.0, *(step.reward for step in steps[1:])], np.float32),  # (T + 1,)
        terminated=step.terminated,
        frames=sum(step.frames for step in steps[1:]),
    )


def _stacked(*observations: NDArray[Any]) -> NDArray[Any]:
    return np.stack(observations)


def collect_episodes(
    environment: Environment, writer: EpisodeWriter, make_policy: MakePolicy, policy: str, until: int, seed: int
) -> Iterator[EpisodeRecord]:
    """Play and store episodes up to number `until`. Episode n depends only on (seed, n) and the policy.

    An episode that fails is dropped and replayed from its seed in a restarted environment, so failures do not change
    what is stored.

    Args:
        environment: environment to play in; an `EnvironmentProcess` can be restarted after a failure.
        writer: episode store to write to.
        make_policy: function that makes the policy of an episode.
        policy: name of the policy, for the record.
        until: number of episodes that the store shall have had, its watermark.
        seed: random seed for the episodes and their policies.

    Yields:
        Record of each episode, once it is safely stored.

    Raises:
        ForbesError: if an episode fails three times, or cannot be stored.
    """
    for number in range(writer.watermark, until):
        seed_of_episode = episode_seed(seed, number)
        episode = play_whole(environment, make_policy, seed_of_episode, number)
        yield writer.append(episode, seed_of_episode, policy, describe_environment(environment))


def episode_seed(seed: int, number: int, purpose: str = "episode") -> int:
    """Return the seed of an episode and its policy.

    Args:
        seed: random seed of the run.
        number: number of the episode.
        purpose: name mixed into the seed, so that e.g. test episodes differ from training episodes.
    """
    return derive_seed(seed, purpose, number) % 2**32  # the range of numpy's legacy generators


def play_whole(
    environment: Environment, make_policy: MakePolicy, seed: int, number: int, attempts: int = ATTEMPTS
) -> Episode:
    """Play an episode, and replay it if the environment fails.

    Args:
        environment: environment to play in.
        make_policy: function that makes the policy of the episode.
        seed: seed of this episode, from `episode_seed`.
        number: number of the episode, for messages.
        attempts: maximal number of attempts.

    Raises:
        ForbesError: if all attempts fail.
    """
    try:
        return play(environment, make_policy(environment, seed), seed)
    except BrokenEnvironmentError as failure:
        if attempts == 1:
            raise ForbesError(
                f"{failure}; episode {number} failed {ATTEMPTS} times and was not stored. Fix the environment"
            ) from failure
        print(f"forbes: {failure}; episode {number} is dropped and replayed", file=sys.stderr)
    return play_whole(environment, make_policy, seed, number, attempts - 1)


def describe_environment(environment: Environment) -> dict[str, Any]:
    """Return the description of an environment for the record of an episode."""
    return environment.describe() | {
        "observation_shape": plain_shape(environment.observation_shape),
        "action_dim": environment.action_dim,
        "discrete": as_plain(environment.discrete),
        "action_repeat": environment.action_repeat,
    }
