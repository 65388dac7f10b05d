"""An agent that learns plays: seed episodes at random, then one by its own policy before every epoch."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from forbes.data import Experience
from forbes.data.episodes.collection import random_policy
from forbes.data.episodes.episode import Episode
from forbes.errors import ForbesError, require_at_least
from forbes.evaluation.reward_prediction import predict_rewards, r2_score
from forbes.files import require_room
from forbes.seeding import derive_seed
from forbes.training.acting import AgentPolicy, WorldModelAgent, play_measured

__all__ = ["Collect", "require_agent"]

_AHEAD = 5  # steps: far enough for what actions do to matter, near enough for most episodes


class Collect(Callback):
    r"""Collects the episodes that an agent learns from, and measures how it does.

    When epoch e begins, S + e episodes have been played: S by a random policy, the others by the agent as it then was,
    with exploration. Episode n is a function of (the training's seed, n) and the weights, so that a resumed run plays
    the same. The store is the run folder's `episodes/`.

    With `overlap`, the episode that epoch e + 1 begins with is played during epoch e, by the agent as it was when e
    began: always one epoch older than it would be otherwise, and so no less reproducible. No other episode is played
    meanwhile: two processes that render on one GPU may wait for each other for ever.

    Logs, at the end of the epoch: `env_steps` (frames of the simulator, action repeat included), `agent_steps`,
    `return/exploring` of the newest episode, and of episodes without exploration, which the agent does not learn from,
    their mean `return/acting` and `reward_explained/5`, the share of their rewards' variance that the world model
    foretells 5 steps ahead (`forbes.evaluation.reward_prediction`).

    Args:
        seed_episodes: S.
        evaluate_every: epochs between two evaluations, of which the last epoch has one.
        evaluation_episodes: of each; their seeds are those of no other episode, and the same each time.
        overlap: play in a process of its own, on the CPU, while the agent learns.

    Raises:
        ForbesError: where a number is below 1; in a fit, where model or data are not those of an agent.
    """

    def __init__(
        self,
        seed_episodes: int = 5,
        evaluate_every: int = 10,
        evaluation_episodes: int = 1,
        overlap: bool = False,
    ) -> None:
        numbers = {"seed_episodes": seed_episodes, "evaluate_every": evaluate_every}
        require_at_least(1, "Collect", **numbers, evaluation_episodes=evaluation_episodes)
        self.seed_episodes, self.overlap = seed_episodes, overlap
        self.evaluate_every, self.evaluation_episodes = evaluate_every, evaluation_episodes

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Open the store, before a checkpoint says how far it had come."""
        require_agent(self, trainer, pl_module)
        self._estimated = False
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
        source, agent = _experience(trainer), cast(WorldModelAgent, pl_module)
        if trainer.current_epoch == 0:  # a start that was cut off in its first epoch has left no checkpoint to say so
            source.watermark = source.begun("random", agent.seed, self.seed_episodes)
        else:  # nor would a run that goes on from the checkpoint draw from what is forgotten now
            source.forget()
        for record in source.collect(self.seed_episodes, random_policy, "random", agent.seed):
            _say(trainer, f"seed episode {record.number + 1}/{self.seed_episodes}: return {record.total_reward:.1f}")
        with _eval_mode(agent):
            until = self.seed_episodes + trainer.current_epoch
            list(source.collect(until, AgentPolicy(agent, exploring=True), type(agent).__name__, agent.seed))
        _warn_of_ends(source, agent)
        self._estimate_room(trainer)
        steps = {"env_steps": float(source.env_steps), "agent_steps": float(source.agent_steps)}
        if source.newest.number >= self.seed_episodes:
            steps["return/exploring"] = source.newest.total_reward
        agent.log_dict(steps, on_step=False, on_epoch=True, batch_size=1)

    def _estimate_room(self, trainer: Trainer) -> None:
        """Warn where the disk will not hold the episodes to come, when the first epoch of this process begins."""
        if not self._estimated and trainer.max_epochs not in (None, -1):
            source, epochs = _experience(trainer), trainer.max_epochs - trainer.current_epoch
            require_room(Path(trainer.default_root_dir), "the episodes to come", source.growth(epochs - 1))
        self._estimated = True

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        """Let the next episode be played, now that other callbacks have played theirs."""
        if self.overlap and batch_idx == 0:
            agent = cast(WorldModelAgent, pl_module)
            _experience(trainer).begin(AgentPolicy.as_it_is(agent, exploring=True), agent.seed)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the episode played meanwhile; measure the agent every few epochs, and at the end."""
        agent, source = cast(WorldModelAgent, pl_module), _experience(trainer)
        if self.overlap:
            source.finish(type(agent).__name__, agent.seed)
        number = trainer.current_epoch + 1
        if number % self.evaluate_every and number != trainer.max_epochs:
            return
        with _eval_mode(agent):
            played = [self.evaluation_episode(trainer, agent, k) for k in range(self.evaluation_episodes)]
            told = [self._foretold(agent, episode, k) for k, episode in enumerate(played)]
        agent.log("return/acting", sum(episode.total_reward for episode in played) / len(played), batch_size=1)
        share = r2_score(told, [torch.from_numpy(episode.reward[1:]).double() for episode in played])
        if share is not None:
            agent.log(f"reward_explained/{_AHEAD}", share, batch_size=1)

    @staticmethod
    def _foretold(agent: WorldModelAgent, episode: Episode, number: int) -> Tensor:
        seed = derive_seed(agent.seed, "foresight", number)
        return predict_rewards(agent, episode, seed, f"evaluation episode {number}", (_AHEAD,))[0]

    def evaluation_episode(self, trainer: Trainer, agent: WorldModelAgent, number: int) -> Episode:
        """Play one of the episodes that measure an agent, in eval mode, while it learns: the same each time."""
        return play_measured(agent, _experience(trainer).environment, "evaluation", agent.seed, number)


def _warn_of_ends(source: Experience, agent: WorldModelAgent) -> None:
    """Say so where episodes end by themselves, and the agent imagines that they do not."""
    if source.newest.terminated and not agent.predicts_termination:
        warnings.warn(
            f"{source.task}: an episode has ended by itself, and this {type(agent).__name__} imagines that none does. "
            "An ImaginationActorCritic foresees it with --model.continuation true",
            stacklevel=2,
        )


@contextmanager
def _eval_mode(agent: WorldModelAgent) -> Iterator[None]:
    training = agent.training
    agent.eval()
    yield
    agent.train(training)


def _experience(trainer: Trainer) -> Experience:
    source: Experience = trainer.datamodule.source  # type: ignore[attr-defined]
    return source


def require_agent(callback: Callback, trainer: Trainer, module: LightningModule) -> None:
    """Raise a ForbesError unless an agent learns on Experience."""
    source = trainer.datamodule.source  # type: ignore[attr-defined]
    if not (isinstance(source, Experience) and isinstance(module, WorldModelAgent)):
        name, found = type(callback).__name__, f"{type(module).__name__} on {type(source).__name__}"
        raise ForbesError(f"{name}: found a {found}, expected an agent on Experience. Leave it out, or change them")


def _say(trainer: Trainer, line: str) -> None:
    if trainer.is_global_zero:
        print(line, flush=True)
