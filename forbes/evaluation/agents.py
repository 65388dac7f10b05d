"""Evaluate agents: their returns in whole episodes without exploration, the same episodes for every agent."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forbes.data.episodes.collection import describe_environment, episode_seed
from forbes.data.episodes.episode import Episode
from forbes.envs import Environment, EnvironmentProcess
from forbes.envs.known_process import KnownProcess
from forbes.errors import ForbesError
from forbes.evaluation.agent_beliefs import exact_variance, learned_variance, prior_and_posterior, uncertainty
from forbes.evaluation.estimates import Estimate, bootstrap_interval
from forbes.evaluation.methods import group_by_method, read_run
from forbes.evaluation.record import require_readable, write_record
from forbes.evaluation.returns import Summary, summarise
from forbes.evaluation.reward_prediction import SAMPLES, predict_rewards, r2_by_steps_ahead
from forbes.pomdps import Process
from forbes.runs.provenance import origin
from forbes.seeding import derive_seed
from forbes.training.acting import WorldModelAgent, play_measured
from forbes.training.loading import loaded_agent

__all__ = ["DISTANCES", "REWARD", "PlayedAgent", "evaluate_agents", "play_test_episode"]
__all__ += ["seed_of_test_episode", "summarise_agents"]

DISTANCES = ("prior_non_gaussianity", "posterior_non_gaussianity")
REWARD = "reward_uncertainty"
_TEST = "test episode"
_APART = ("made_by", "shows", "views", "observation_shape")
"""Fields in which environments of one task may differ: the rewards do not depend on what the agent is shown."""


class EpisodeMeasures(NamedTuple):
    """What is measured in one test episode of T actions."""

    total_reward: float
    """Undiscounted return."""
    reward: Tensor
    """Observed rewards, `(T,)`, float64."""
    predicted: dict[int, Tensor]
    """Predicted rewards by steps ahead, from `predict_rewards`."""
    distance: Tensor | None
    """KL of prior and posterior from a Gaussian, `(2,)`; None if s is discrete."""
    variances: tuple[Tensor, Tensor] | None
    """Variance of each reward under the learned and the exact belief, `(T,)` each; None if no exact belief is known."""


class PlayedAgent(NamedTuple):
    """A run and its results in the test episodes."""

    run: str
    agent: WorldModelAgent
    returns: Tensor
    """Undiscounted return of each episode, `(E,)`, float64."""
    r2: dict[int, Estimate | None]
    """R² of the predicted rewards by steps ahead."""
    belief: dict[str, Estimate]
    """Metrics of the belief: `DISTANCES` from a Gaussian if s is continuous, `REWARD` if the exact belief is known."""
    environment: dict[str, Any]
    checkpoint: str
    """SHA-256 of the evaluated checkpoint."""


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


def summarise_agents(played: Sequence[PlayedAgent]) -> Summary | None:
    """Summarise the mean return of each run over the seeds of each method; None unless there are seeds and methods."""
    means = {one.run: one.returns.mean().item() for one in played}
    task = played[0].environment["task"]
    methods = group_by_method([read_run(run)._replace(task=task) for run in means])[task]
    if len(methods) == len(played):
        return None
    return summarise({title: {task: [means[run.path] for run in runs]} for title, runs in methods.items()})


def _play(
    run: str, agent: WorldModelAgent, environment: EnvironmentProcess, checkpoint: str, episodes: int, seed: int
) -> PlayedAgent:
    process = _known_process(environment)
    measured: list[EpisodeMeasures] = []
    for number in _counted(run, episodes):
        episode = play_test_episode(agent, environment, seed, number)
        name, of_samples = f"{run}, test episode {number}", derive_seed(seed, "foresight", number)
        measured.append(_measure(agent, episode, process, of_samples, name))
    returns = torch.tensor([episode.total_reward for episode in measured], dtype=torch.float64)  # (E,)
    r2 = r2_by_steps_ahead([episode.predicted for episode in measured], [episode.reward for episode in measured])
    distances = [episode.distance for episode in measured if episode.distance is not None]  # E x (2,), or none
    variances = [episode.variances for episode in measured if episode.variances is not None]  # E x 2 x (T,), or none
    belief: dict[str, Estimate] = {}
    if distances:
        belief |= zip(DISTANCES, map(Estimate.of, torch.stack(distances, 1)), strict=True)  # 2 x (E,)
    if variances and (ratio := uncertainty(*zip(*variances, strict=True))):
        belief[REWARD] = ratio
    return PlayedAgent(run, agent, returns, r2, belief, describe_environment(environment), checkpoint)


def _measure(
    agent: WorldModelAgent, episode: Episode, process: Process | None, seed: int, name: str
) -> EpisodeMeasures:
    """Measure one episode; `seed` is the random seed for samples of the beliefs, `name` is for error messages."""
    variances = None
    if process is not None:
        variances = learned_variance(agent, episode, seed), exact_variance(process, episode, seed)
    return EpisodeMeasures(
        total_reward=episode.total_reward,
        reward=torch.from_numpy(episode.reward[1:]).double(),
        predicted=predict_rewards(agent, episode, seed, name),
        distance=prior_and_posterior(agent, episode, seed),
        variances=variances,
    )


def _known_process(environment: EnvironmentProcess) -> Process | None:
    """Return the environment's process if it shows observations and its exact belief is known, else None."""
    if environment.describe().get("shows") != "observation":
        return None
    known = environment.make()
    return known.process if isinstance(known, KnownProcess) else None


def _record(one: PlayedAgent, folder: Path, seed: int, command: str) -> None:
    measured = {"checkpoint": one.checkpoint, **origin(command, seed)}
    entry = {
        **Estimate.of(one.returns)._asdict(),
        "interval_95": bootstrap_interval(one.returns),
        "returns": one.returns.tolist(),
        "environment": one.environment,
    }
    samples = one.agent.acting_samples
    tag = f"episodes={len(one.returns)}{'' if samples == 1 else f',K={samples}'}"
    others = {
        f"reward_explained[ahead={ahead},S={SAMPLES},{tag}]": r2._asdict() | measured
        for ahead, r2 in one.r2.items()
        if r2 is not None
    }
    others |= {f"{metric}[{tag}]": estimate._asdict() | measured for metric, estimate in one.belief.items()}
    name = f"return[{tag}]"
    write_record(folder, {name: entry | measured} | others, {name: one.returns})


def play_test_episode(agent: WorldModelAgent, environment: Environment, seed: int, number: int) -> Episode:
    """Play a test episode, which was not used in training. The same seed gives every agent the same episode."""
    return play_measured(agent, environment, _TEST, seed, number)


def seed_of_test_episode(seed: int, number: int) -> int:
    """Return the seed with which `play_test_episode` resets the environment."""
    return episode_seed(seed, number, _TEST)


def _counted(run: str, episodes: int) -> Iterator[int]:
    """Yield the number of each episode, and print progress after it."""
    for number in range(episodes):
        yield number
        print(f"{run}: {number + 1}/{episodes} episodes", file=sys.stderr, flush=True)


def _require_same_task(first: PlayedAgent, run: str, task: dict[str, Any]) -> None:
    ours, theirs = ({k: v for k, v in fields.items() if k not in _APART} for fields in (first.environment, task))
    if ours != theirs:
        raise ForbesError(
            f"{run}: its task is {theirs['task']} ({theirs}), that of {first.run} is {ours['task']} ({ours}), "
            "expected the same. Compare agents of one task"
        )
