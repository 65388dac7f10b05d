"""`forbes data collect`: collect episodes of a random policy or a trained agent."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import track

from forbes.commands.episodes import count_steps
from forbes.data.episodes.collection import MakePolicy, collect_episodes, random_policy
from forbes.data.episodes.episode import EpisodeRecord
from forbes.data.episodes.store import EpisodeWriter
from forbes.data.episodes.worker import collect_in_parallel
from forbes.envs import EnvironmentProcess, find_environment
from forbes.errors import ForbesError
from forbes.files import require_room
from forbes.training.acting import AgentPolicy
from forbes.training.loading import loaded_agent

__all__ = ["collect"]

_RANDOM = "random"


def collect(output: Path, episodes: int, policy: str, seed: int, workers: int = 1, **environment: Any) -> None:
    """Play episodes in separate processes and store them. If interrupted, the same call resumes.

    Args:
        output: folder of the episode store.
        episodes: number of stored episodes at the end, including those of earlier calls.
        policy: "random", or the run folder of an agent, which explores as in training.
        seed: random seed. Episode n is a function of (seed, n) and the policy.
        workers: number of episodes that are played at the same time; they are the same, in the same order.
        environment: task, options of its constructor, timeout in seconds and time limit in steps; None for a default.

    Raises:
        ForbesError: if the task or run does not exist, if an agent is given a task, or if an episode fails.
    """
    given = {name: value for name, value in environment.items() if value is not None}
    with _acting(policy, given) as (played_in, make_policy), EpisodeWriter(output) as writer:
        missing = max(0, episodes - writer.watermark)
        play = collect_episodes if workers == 1 else partial(collect_in_parallel, workers)
        played = play(played_in, writer, make_policy, policy, episodes, seed)
        records: list[EpisodeRecord] = []
        for record in track(played, f"Playing {played_in.describe()['task']}", total=missing):
            if not records:
                require_room(output, "the remaining episodes", (missing - 1) * record.size)
            records.append(record)
    print(f"{output}: {len(records)} episodes stored, {count_steps(records)}; {writer.watermark} in all")


@contextmanager
def _acting(policy: str, given: dict[str, Any]) -> Iterator[tuple[EnvironmentProcess, MakePolicy]]:
    """Yield the environment and the policy; an agent acts in the environment of its run."""
    if policy != _RANDOM:
        if given:
            flag = "--" + min(given).replace("_", "-")
            raise ForbesError(
                f"--policy {policy}: an agent acts in the environment of its run, expected no {flag}. Remove it"
            )
        with loaded_agent(policy, "cpu") as (agent, environment, _):
            yield environment, AgentPolicy.as_it_is(agent, exploring=True)
    elif "task" not in given:
        raise ForbesError(f"--policy {_RANDOM}: needs an environment. Name one: --task TASK")
    else:
        limits = {name: given.pop(name) for name in ("timeout", "time_limit") if name in given}
        with EnvironmentProcess(find_environment(**given), **limits) as environment:
            yield environment, random_policy
