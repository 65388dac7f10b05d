"""The tables of `forbes evaluate` of agents: one row per run."""

import itertools
from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.evaluation.agents import DISTANCES, REWARD, PlayedAgent, summarise_agents
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.reward_prediction import STEPS_AHEAD

__all__ = ["print_agents"]


def print_agents(played: Sequence[PlayedAgent]) -> None:
    """Print the returns, the reward predictions, the measures of the beliefs, and all paired differences."""
    screen = console(160)
    episodes, how = len(played[0].returns), "undiscounted, mean ± standard error; the same episodes for all"
    table = Table(title=f"return in {episodes} episodes, by the mean action of K trajectories of the belief: {how}")
    for header in ("run", "agent", "parameters", "K", "return", "lowest", "highest"):
        table.add_column(header, overflow="fold", justify="left" if header in ("run", "agent") else "right")
    for one in played:
        size = sum(parameter.numel() for parameter in one.agent.parameters())
        ends = (f"{end.item():.1f}" for end in (one.returns.min(), one.returns.max()))
        kind = f"{type(one.agent).__name__}, {type(one.agent.model.posterior).__name__}"
        samples = str(one.agent.acting_samples)
        table.add_row(escape(one.run), kind, f"{size:,}", samples, str(Estimate.of(one.returns)), *ends)
    screen.print(table)
    screen.print(_reward_prediction(played))
    if any(one.belief for one in played):
        screen.print(_beliefs(played))
    for first, second in itertools.combinations(played, 2):
        difference = Estimate.of(first.returns - second.returns)
        screen.print(f"{escape(first.run)} minus {escape(second.run)}, paired: {difference}")
    if summary := summarise_agents(played):
        screen.print("interquartile mean over seeds of these mean returns, with 95 % bootstrap intervals of the seeds")
        screen.print(*map(escape, summary.lines()), sep="\n", highlight=False)


def _reward_prediction(played: Sequence[PlayedAgent]) -> Table:
    title = "R² of the rewards in these episodes, predicted by the world model for the actions taken"
    table = Table("run", title=f"{title}; 0 is no better than the mean reward")
    for ahead in STEPS_AHEAD:
        table.add_column(f"{ahead} steps ahead" if ahead else "current step", justify="right")
    for one in played:
        r2_scores = (one.r2[ahead] for ahead in STEPS_AHEAD)
        table.add_row(escape(one.run), *("n/a" if r2 is None else str(r2) for r2 in r2_scores))
    return table


def _beliefs(played: Sequence[PlayedAgent]) -> Table:
    table = Table("run", title="belief: KL from the nearest Gaussian, and variance of the reward it has just observed")
    for column in ("prior, nats per step", "posterior, nats per step", "variance of the reward / exact belief's"):
        table.add_column(column, justify="right")
    for one in played:
        *distances, reward = (one.belief.get(metric) for metric in (*DISTANCES, REWARD))
        nats = ("n/a" if each is None else f"{each.mean:z.3f} ± {each.standard_error:.3f}" for each in distances)
        table.add_row(escape(one.run), *nats, "n/a" if reward is None else str(reward))
    return table
