"""Evaluate agents: their returns in whole episodes without exploration, the same episodes for every agent."""

import sys
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forbes.data import Experience
from forbes.data.episodes.collection import describe_environment
from forbes.data.episodes.episode import Episode
from forbes.envs import Environment, EnvironmentProcess
from forbes.envs.known_process import KnownProcess
from forbes.errors import ForbesError
from forbes.evaluation.agent_beliefs import exact_variance, learned_variance, prior_and_posterior, uncertainty
from forbes.evaluation.estimates import Estimate, bootstrap_interval
from forbes.evaluation.record import require_readable, write_record
from forbes.evaluation.reward_prediction import SAMPLES, STEPS_AHEAD, explained, predict_rewards
from forbes.pomdps import Process
from forbes.runs.provenance import commit
from forbes.seeding import derive_seed
from forbes.training.acting import WorldModelAgent, play_measured
from forbes.training.loading import load_run, loaded_agent

__all__ = ["DISTANCES", "REWARD", "PlayedAgent", "evaluate_agents", "is_agent", "play_test_episode"]

DISTANCES = ("prior_non_gaussianity", "posterior_non_gaussianity")
REWARD = "reward_uncertainty"
_APART = ("made_by", "shows", "observation_shape")
"""Fields in which environments of one task may differ: the rewards do not depend on what the agent is shown."""


class PlayedAgent(NamedTuple):
    """A run and its results in the test episodes."""

    run: str
    agent: WorldModelAgent
    returns: Tensor
    """Undiscounted return of each episode, `(E,)`, float64."""
    explained: list[Estimate | None]
    """R² of the predicted rewards, for each of `STEPS_AHEAD`."""
    belief: dict[str, Estimate]
    """Metrics of the belief: `DISTANCES` from a Gaussian if s is continuous, `REWARD` if the exact belief is known."""
    environment: dict[str, Any]
    checkpoint: str
    """SHA-256 of the evaluated checkpoint."""


def is_agent(run: str) -> bool:
    """Return whether a run folder holds an agent, which is evaluated by its returns."""
    module, data = load_run(run)
    if isinstance(data.source, Experience):
        data.source.close()
    return isinstance(module, WorldModelAgent)


def evaluate_agents(
    runs: Mapping[str, Path], episodes: int, samples: int | None, seed: int, device: str, command: str
) -> list[PlayedAgent]:
    """Let every agent play the same episodes, and record its returns.

    Episode k is reset with the same seed for every run, and no such seed was used in training. Actions are the mode of
    the policy, or the plan, without noise.

    Args:
        runs: run folders, and the folder for the record of each.
        episodes: number of episodes, E, at least 2.
        samples: number of belief samples per action, K; None for the agent's own number.
        seed: random seed for the episodes.
        device: device of the models.
        command: command line, for the record.

    Raises:
        ForbesError: if a run does not hold an agent, or its task differs from that of the first run.
    """
    if episodes < 2:
        raise ForbesError(f"--episodes {episodes}: a standard error needs at least 2. Choose more")
    require_readable(runs.values())
    played: list[PlayedAgent] = []
    for run, folder in runs.items():
        with loaded_agent(run, device, samples) as (agent, environment, checkpoint):
            for first in played[:1]:
                _require_same_task(first, run, describe_environment(environment))
            played.append(_play(run, agent, environment, checkpoint, episodes, seed))
        _record(played[-1], folder, seed, command)
    return played


def _play(
    run: str, agent: WorldModelAgent, environment: EnvironmentProcess, checkpoint: str, episodes: int, seed: int
) -> PlayedAgent:
    returns, rewards, foretold = list[float](), list[Tensor](), list[list[Tensor]]()
    process, variances, distances = _known_process(environment), list[tuple[Tensor, Tensor]](), list[Tensor]()
    for number in _counted(run, episodes):
        episode = play_test_episode(agent, environment, seed, number)
        returns.append(episode.total_reward)
        rewards.append(torch.from_numpy(episode.reward[1:]).double())  # (T,)
        draws = derive_seed(seed, "foresight", number)
        foretold.append(predict_rewards(agent, episode, draws, f"{run}, test episode {number}"))
        if (distance := prior_and_posterior(agent, episode, draws)) is not None:
            distances.append(distance)
        if process is not None:
            variances.append((learned_variance(agent, episode, draws), exact_variance(process, episode, draws)))
    total = torch.tensor(returns, dtype=torch.float64)  # (E,)
    belief = dict[str, Estimate]()
    if distances:
        belief |= zip(DISTANCES, map(Estimate.of, torch.stack(distances, 1)), strict=True)  # 2 x (E,)
    if variances:
        belief[REWARD] = uncertainty(*zip(*variances, strict=True))
    return PlayedAgent(
        run, agent, total, explained(foretold, rewards), belief, describe_environment(environment), checkpoint
    )


def _known_process(environment: EnvironmentProcess) -> Process | None:
    """Return the environment's process if it shows observations and its exact belief is known, else None."""
    if environment.describe().get("shows") != "observation":
        return None
    known = environment.make()
    return known.process if isinstance(known, KnownProcess) else None


def _record(one: PlayedAgent, folder: Path, seed: int, command: str) -> None:
    measured = {
        "checkpoint": one.checkpoint,
        "command": command,
        "commit": commit(),
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    entry = {
        **Estimate.of(one.returns)._asdict(),
        "interval_95": bootstrap_interval(one.returns),
        "returns": one.returns.tolist(),
        "environment": one.environment,
    }
    samples = one.agent.acting_samples
    tag = f"episodes={len(one.returns)}{'' if samples == 1 else f',K={samples}'}"
    shares = {
        f"reward_explained[ahead={distance},S={SAMPLES},{tag}]": share._asdict() | measured
        for distance, share in zip(STEPS_AHEAD, one.explained, strict=True)
        if share is not None
    }
    shares |= {f"{metric}[{tag}]": estimate._asdict() | measured for metric, estimate in one.belief.items()}
    name = f"return[{tag}]"
    write_record(folder, {name: entry | measured} | shares, {name: one.returns})


def play_test_episode(agent: WorldModelAgent, environment: Environment, seed: int, number: int) -> Episode:
    """Play a test episode, which was not used in training. The same seed gives every agent the same episode."""
    return play_measured(agent, environment, "test episode", seed, number)


def _counted(run: str, episodes: int) -> Iterator[int]:
    """Yield the number of each episode, and print progress after it."""
    for number in range(episodes):
        yield number
        print(f"{run}: {number + 1}/{episodes} episodes", file=sys.stderr, flush=True)


def _require_same_task(first: PlayedAgent, run: str, task: dict[str, Any]) -> None:
    ours, theirs = ({k: v for k, v in each.items() if k not in _APART} for each in (first.environment, task))
    if ours != theirs:
        raise ForbesError(
            f"{run}: its task is {theirs['task']} ({theirs}), that of {first.run} is {ours['task']} ({ours}), "
            "expected the same. Compare agents of one task"
        )
