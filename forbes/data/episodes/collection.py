"""Playing episodes: an environment, a policy and a seed become an `Episode`."""

import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode, EpisodeRecord
from forbes.data.episodes.store import EpisodeWriter
from forbes.envs import BrokenEnvironmentError, Environment, Step
from forbes.errors import ForbesError
from forbes.seeding import derive_seed

__all__ = [
    "ATTEMPTS",
    "MakePolicy",
    "Policy",
    "collect_episodes",
    "describe_environment",
    "episode_seed",
    "play",
    "play_whole",
    "random_policy",
]

Policy: TypeAlias = Callable[[NDArray[Any]], NDArray[np.float32]]
"""Chooses a_t, float32 `(A,)`, when it is shown o_t; it lives for one episode, so it may remember."""
MakePolicy: TypeAlias = Callable[[Environment, int], Policy]
"""Makes the policy of an episode from the environment's numbers and a seed."""

ATTEMPTS = 3
"""How often an episode is begun before it is given up."""


def random_policy(environment: Environment, seed: int) -> Policy:
    """Make a policy that draws each action alike, independent of all else: uniform in [-1, 1]^A, or one of A."""
    random, count = np.random.default_rng(seed), environment.action_dim
    if environment.discrete:
        return lambda _: np.eye(count, dtype=np.float32)[random.integers(count)]
    return lambda _: random.uniform(-1, 1, count).astype(np.float32)


def play(environment: Environment, policy: Policy, seed: int) -> Episode:
    """Play one episode from its reset to its end; whatever goes wrong, nothing is left of it.

    Raises:
        BrokenEnvironmentError: where a process that owns the environment has failed.
        ForbesError: where the policy gives what is no action.
    """
    step = environment.reset(seed)
    steps: list[Step] = [step]
    actions = [np.zeros(environment.action_dim, np.float32)]
    while not (step.terminated or step.truncated):
        action = policy(step.observation)
        if action.shape != actions[0].shape or not np.isfinite(action).all():
            raise ForbesError(
                f"{environment.describe()['task']}: the policy's action at step {len(steps) - 1} is {action}, "
                f"expected {environment.action_dim} finite numbers. Mend the policy"
            )
        step = environment.step(action)
        steps.append(step)
        actions.append(action)
    return Episode(
        observation=np.stack([each.observation for each in steps]),  # (T + 1, ...)
        action=np.stack(actions),  # (T + 1, A)
        reward=np.array([0.0, *(each.reward for each in steps[1:])], np.float32),  # (T + 1,)
        terminated=step.terminated,
        frames=sum(each.frames for each in steps[1:]),
    )


def collect_episodes(
    environment: Environment, writer: EpisodeWriter, make_policy: MakePolicy, policy: str, until: int, seed: int
) -> Iterator[EpisodeRecord]:
    """Play and store episodes until the store has had so many; episode n depends on (seed, n) and the policy only.

    An episode that breaks is dropped, and played again from its seed in an environment started anew: what is stored
    does not depend on it.

    Args:
        environment: an `EnvironmentProcess`, if a failure is to be survived.
        writer: of the store.
        make_policy: makes the policy of an episode.
        policy: its name, for the record.
        until: the watermark to reach.
        seed: of the episodes and their policies.

    Yields:
        The record of each episode when it is safe on the disk.

    Raises:
        ForbesError: where an episode breaks three times, or cannot be stored.
    """
    for number in range(writer.watermark, until):
        chance = episode_seed(seed, number)
        episode = play_whole(environment, make_policy, chance, number)
        yield writer.append(episode, chance, policy, describe_environment(environment))


def episode_seed(seed: int, number: int, purpose: str = "episode") -> int:
    """Return the seed of an episode and its policy; `purpose` keeps those that measure apart from those collected."""
    return derive_seed(seed, purpose, number) % 2**32  # what numpy's older generators take


def play_whole(
    environment: Environment, make_policy: MakePolicy, seed: int, number: int, attempts: int = ATTEMPTS
) -> Episode:
    """Play an episode, and play it again where it breaks; `seed` and `number` are the episode's own.

    Raises:
        ForbesError: where it breaks three times.
    """
    try:
        return play(environment, make_policy(environment, seed), seed)
    except BrokenEnvironmentError as failure:
        if attempts == 1:
            raise ForbesError(
                f"{failure}; so broke episode {number} {ATTEMPTS} times, nothing of it is stored. Mend the environment"
            ) from failure
        print(f"forbes: {failure}; episode {number} is dropped and played again", file=sys.stderr)
    return play_whole(environment, make_policy, seed, number, attempts - 1)


def describe_environment(environment: Environment) -> dict[str, Any]:
    """Return all that the record of an episode says of its environment."""
    return environment.describe() | {
        "observation_shape": list(environment.observation_shape),
        "action_dim": environment.action_dim,
        "discrete": environment.discrete,
        "action_repeat": environment.action_repeat,
    }
