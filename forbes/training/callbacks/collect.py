"""An agent that learns plays: seed episodes at random, then one by its own policy before every epoch."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from lightning import Callback, LightningModule, Trainer

from forbes.data import Experience
from forbes.data.collection import MakePolicy, play, random_policy
from forbes.errors import ForbesError
from forbes.seeding import derive_seed
from forbes.training.acting import Acting, ActingModel

__all__ = ["Collect"]


class Collect(Callback):
    r"""Collects the episodes that an agent learns from, and measures how it does.

    When epoch e begins, S + e episodes have been played: S by a random policy, the others by the agent as it then was,
    with exploration. Episode n is a function of (seed, n) and the weights, so that a resumed run plays the same.
    The store is the run folder's `episodes/`.

    With `overlap`, the episode that epoch e + 1 begins with is played during epoch e, by the agent as it was when e
    began: always one epoch older than it would be otherwise, and so no less reproducible.

    Logs, at the end of the epoch: `env_steps` (frames of the simulator, action repeat included), `agent_steps`,
    `return/exploring` of the newest episode, and `return/acting`, the mean return of episodes without exploration.

    Args:
        seed_episodes: S.
        evaluate_every: epochs between two evaluations, of which the last epoch has one.
        evaluation_episodes: of each; their seeds are those of no other episode, and the same each time.
        seed: of all the episodes.
        overlap: play in a process of its own, on the CPU, while the agent learns.

    Raises:
        ForbesError: where a number is below 1; in a fit, where model or data are not those of an agent.
    """

    def __init__(
        self,
        seed_episodes: int = 5,
        evaluate_every: int = 10,
        evaluation_episodes: int = 1,
        seed: int = 0,
        overlap: bool = False,
    ) -> None:
        numbers = {"seed_episodes": seed_episodes, "evaluate_every": evaluate_every}
        for name, value in (numbers | {"evaluation_episodes": evaluation_episodes}).items():
            if value < 1:
                raise ForbesError(f"Collect: {name} is {value}, expected at least 1")
        self.seed_episodes, self.seed, self.overlap = seed_episodes, seed, overlap
        self.evaluate_every, self.evaluation_episodes = evaluate_every, evaluation_episodes

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Open the store, before a checkpoint says how far it had come."""
        _require_agent(trainer, pl_module)
        if stage == "fit":
            _experience(trainer).open(Path(trainer.default_root_dir) / "episodes")

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the store and the environment."""
        _experience(trainer).close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Close them where the training has been cut off, too."""
        if isinstance(source := trainer.datamodule.source, Experience):  # type: ignore[attr-defined]
            source.close()

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Play what is missing."""
        source, agent = _experience(trainer), cast(ActingModel, pl_module)
        for record in source.collect(self.seed_episodes, random_policy, "random", self.seed):
            _say(trainer, f"seed episode {record.number + 1}/{self.seed_episodes}: return {record.total_reward:.1f}")
        with _acting(agent, exploring=True) as make_policy:
            until = self.seed_episodes + trainer.current_epoch
            list(source.collect(until, make_policy, type(agent).__name__, self.seed))
        if self.overlap:
            source.begin(Acting.as_it_is(agent, exploring=True), self.seed)
        steps = {"env_steps": float(source.env_steps), "agent_steps": float(source.agent_steps)}
        if source.newest.number >= self.seed_episodes:
            steps["return/exploring"] = source.newest.total_reward
        agent.log_dict(steps, on_step=False, on_epoch=True, batch_size=1)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the episode played meanwhile; measure the agent every few epochs, and at the end."""
        agent, source = cast(ActingModel, pl_module), _experience(trainer)
        if self.overlap:
            source.finish(type(agent).__name__, self.seed)
        number = trainer.current_epoch + 1
        if number % self.evaluate_every and number != trainer.max_epochs:
            return
        environment = source.environment
        returns = []
        with _acting(agent, exploring=False) as make_policy:
            for place in range(self.evaluation_episodes):
                chance = derive_seed(self.seed, "evaluation", place) % 2**32
                returns.append(play(environment, make_policy(environment, chance), chance).reward.sum(dtype="float64"))
        agent.log("return/acting", sum(returns) / len(returns), batch_size=1)


@contextmanager
def _acting(agent: ActingModel, exploring: bool) -> Iterator[MakePolicy]:
    """Give what makes the agent's policy for an episode, in eval mode."""
    training = agent.training
    agent.eval()
    yield Acting(agent, exploring)
    agent.train(training)


def _experience(trainer: Trainer) -> Experience:
    source: Experience = trainer.datamodule.source  # type: ignore[attr-defined]
    return source


def _require_agent(trainer: Trainer, module: LightningModule) -> None:
    source = trainer.datamodule.source  # type: ignore[attr-defined]
    if not (isinstance(source, Experience) and isinstance(module, ActingModel)):
        found = f"{type(module).__name__} on {type(source).__name__}"
        raise ForbesError(f"Collect: found a {found}, expected an agent on Experience. Leave it out, or change them")


def _say(trainer: Trainer, line: str) -> None:
    if trainer.is_global_zero:
        print(line, flush=True)
