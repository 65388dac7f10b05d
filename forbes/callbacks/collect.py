"""Collect episodes during training: seed episodes with random actions, then some by the agent before every epoch."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from forbes.data import Experience
from forbes.data.datamodule import datamodule_of
from forbes.data.episodes.collection import random_policy
from forbes.data.episodes.episode import Episode, EpisodeRecord
from forbes.errors import ForbesError, require_at_least
from forbes.evaluation.reward_prediction import predict_rewards, r2_score
from forbes.files import require_room
from forbes.seeding import derive_seed
from forbes.training.acting import AgentPolicy, WorldModelAgent, play_measured

__all__ = ["Collect", "require_agent"]

_AHEAD = 5  # steps: far enough for actions to matter, and available in most episodes


class Collect(Callback):
    r"""Collects the episodes from which an agent learns, and evaluates the agent.

    At the start of epoch e, S + E e episodes have been played: S by a random policy, the others by the agent of that
    time with exploration. Episode n is a function of (training seed, n) and the weights, so a resumed run plays the
    same episodes. They are stored in `episodes/` of the run folder.

    With `overlap`, the episode of epoch e + 1 is played during epoch e, with the weights at the start of e. These are
    one epoch older than without `overlap`, but just as reproducible. No other episode is played at the same time, since
    two processes that render on one GPU can deadlock.

    Of the R processes of one training, the first plays and stores all episodes, while the others wait for it. With
    `per_rank`, each plays every R-th episode, and the first stores them in their order. So the store, and every batch,
    is the same for any R. Each process should render on a GPU of its own.

    Logs at the end of an epoch: `env_steps` (simulator frames, including action repeat), `agent_steps`, and
    `return/exploring`, the mean over the newest E episodes. Every `evaluate_every` epochs also, over episodes without
    exploration that are not used for training, the mean `return/acting` and `reward_explained/5`, the R² of the rewards
    predicted 5 steps ahead (`forbes.evaluation.reward_prediction`).

    Args:
        seed_episodes: number of episodes with random actions, S.
        evaluate_every: number of epochs between evaluations. The last epoch is always evaluated.
        evaluation_episodes: number of episodes per evaluation, the same ones every time.
        overlap: play in a separate process, on the CPU, while the agent learns.
        episodes: number of episodes by the agent per epoch, E.
        per_rank: share the episodes out over the processes of the training.

    Raises:
        ForbesError: if a number is below 1, if `overlap` would play several episodes, or, at the start of a fit, if the
            model is not an agent on `Experience`.
    """

    def __init__(
        self,
        seed_episodes: int = 5,
        evaluate_every: int = 10,
        evaluation_episodes: int = 1,
        overlap: bool = False,
        episodes: int = 1,
        per_rank: bool = False,
    ) -> None:
        numbers = {"seed_episodes": seed_episodes, "evaluate_every": evaluate_every, "episodes": episodes}
        require_at_least(1, "Collect", **numbers, evaluation_episodes=evaluation_episodes)
        if overlap and (episodes > 1 or per_rank):
            found = f"episodes {episodes}" if episodes > 1 else "per_rank"
            raise ForbesError(f"Collect: overlap plays one episode at a time, found {found}. Set overlap to false")
        self.seed_episodes, self.overlap, self.episodes, self.per_rank = seed_episodes, overlap, episodes, per_rank
        self.evaluate_every, self.evaluation_episodes = evaluate_every, evaluation_episodes

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Open the store, before a checkpoint is loaded."""
        require_agent(self, trainer, pl_module)
        self._estimated = False
        if stage == "fit":
            source = _experience(trainer)
            folder = Path(trainer.strategy.broadcast(trainer.default_root_dir)) / "episodes"
            if trainer.is_global_zero:
                source.open(folder)
            else:
                source.followed = folder

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the store and the environment."""
        _experience(trainer).close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Close them after an error, too."""
        if isinstance(source := datamodule_of(trainer).source, Experience):
            source.close()

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Play the missing episodes."""
        source, agent = _experience(trainer), cast(WorldModelAgent, pl_module)
        if trainer.is_global_zero:
            self._tidy(trainer, source, agent)
        if trainer.is_global_zero or self.per_rank:
            self._play(trainer, source, agent)
        steps = trainer.strategy.broadcast(self._steps(trainer, source, agent) if trainer.is_global_zero else {})
        if not trainer.is_global_zero:
            source.follow()
        agent.log_dict(steps, on_step=False, on_epoch=True, batch_size=1)

    def _tidy(self, trainer: Trainer, source: Experience, agent: WorldModelAgent) -> None:
        """Remove the episodes that are not used any more."""
        if trainer.current_epoch == 0:  # without a checkpoint, keep only the valid seed episodes of an earlier start
            source.watermark = source.begun("random", agent.seed, self.seed_episodes)
        else:  # a run resumed from the checkpoint would not sample from the episodes deleted now
            source.forget(self.episodes)

    def _play(self, trainer: Trainer, source: Experience, agent: WorldModelAgent) -> None:
        """Play the missing episodes."""
        stored = source.watermark or 0  # the first process has the store
        first = trainer.strategy.broadcast(stored) if self.per_rank else stored
        until = self.seed_episodes + self.episodes * trainer.current_epoch
        seeds, others = range(first, self.seed_episodes), range(max(first, self.seed_episodes), until)
        for record in source.collect(seeds, random_policy, "random", agent.seed, self.per_rank):
            played = f"seed episode {record.number + 1}/{self.seed_episodes}"
            print(f"{played}: return {record.total_reward:.1f}", flush=True)
        with _eval_mode(agent):
            policy, name = AgentPolicy(agent, exploring=True), type(agent).__name__
            list(source.collect(others, policy, name, agent.seed, self.per_rank))

    def _steps(self, trainer: Trainer, source: Experience, agent: WorldModelAgent) -> dict[str, float]:
        """Return what is logged of the episodes so far; warn of what a user should know of them."""
        _warn_of_termination(source.task, source.newest(self.episodes), agent)
        self._estimate_room(trainer)
        steps = {"env_steps": float(source.env_steps), "agent_steps": float(source.agent_steps)}
        returns = [one.total_reward for one in source.newest(self.episodes) if one.number >= self.seed_episodes]
        return steps | ({"return/exploring": sum(returns) / len(returns)} if returns else {})

    def _estimate_room(self, trainer: Trainer) -> None:
        """Warn in the first epoch of this process if the disk is too small for the remaining episodes."""
        if not self._estimated and trainer.max_epochs not in (None, -1):
            source, epochs = _experience(trainer), trainer.max_epochs - trainer.current_epoch
            require_room(
                Path(trainer.default_root_dir), "the remaining episodes", source.growth(self.episodes * (epochs - 1))
            )
        self._estimated = True

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        """Start the next episode in the background, after other callbacks have played theirs."""
        if self.overlap and batch_idx == 0 and trainer.is_global_zero:
            agent = cast(WorldModelAgent, pl_module)
            _experience(trainer).begin(AgentPolicy.as_it_is(agent, exploring=True), agent.seed)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the episode played in the background; evaluate the agent every few epochs, and at the end."""
        agent, source = cast(WorldModelAgent, pl_module), _experience(trainer)
        if self.overlap and trainer.is_global_zero:
            source.finish(type(agent).__name__, agent.seed)
        epoch = trainer.current_epoch + 1
        if epoch % self.evaluate_every and epoch != trainer.max_epochs:
            return
        measured = self._evaluate(trainer, agent) if trainer.is_global_zero else {}
        agent.log_dict(trainer.strategy.broadcast(measured), batch_size=1)

    def _evaluate(self, trainer: Trainer, agent: WorldModelAgent) -> dict[str, float]:
        """Play the evaluation episodes, and return what is logged of them."""
        with _eval_mode(agent):
            played = [self.evaluation_episode(trainer, agent, k) for k in range(self.evaluation_episodes)]
            predicted = [self._predict_rewards(agent, episode, k) for k, episode in enumerate(played)]
        r2 = r2_score(predicted, [torch.from_numpy(episode.reward[1:]).double() for episode in played])
        mean = sum(episode.total_reward for episode in played) / len(played)
        return {"return/acting": mean} | ({} if r2 is None else {f"reward_explained/{_AHEAD}": r2})

    @staticmethod
    def _predict_rewards(agent: WorldModelAgent, episode: Episode, number: int) -> Tensor:
        seed = derive_seed(agent.seed, "foresight", number)
        return predict_rewards(agent, episode, seed, f"evaluation episode {number}", (_AHEAD,))[_AHEAD]

    def evaluation_episode(self, trainer: Trainer, agent: WorldModelAgent, number: int) -> Episode:
        """Play evaluation episode `number`, the same every time, with the agent in eval mode."""
        return play_measured(agent, _experience(trainer).environment, "evaluation", agent.seed, number)


def _warn_of_termination(task: str, records: Sequence[EpisodeRecord], agent: WorldModelAgent) -> None:
    """Warn if an episode terminated, but the agent does not predict termination."""
    if any(record.terminated for record in records) and not agent.predicts_termination:
        warnings.warn(
            f"{task}: an episode terminated, but this {type(agent).__name__} does not predict termination. An "
            "ImaginationActorCritic does with --model.continuation true",
            stacklevel=2,
        )


@contextmanager
def _eval_mode(agent: WorldModelAgent) -> Iterator[None]:
    training = agent.training
    agent.eval()
    yield
    agent.train(training)


def _experience(trainer: Trainer) -> Experience:
    return cast(Experience, datamodule_of(trainer).source)


def require_agent(callback: Callback, trainer: Trainer, module: LightningModule) -> None:
    """Raise a ForbesError unless an agent learns on Experience."""
    source = datamodule_of(trainer).source
    if not (isinstance(source, Experience) and isinstance(module, WorldModelAgent)):
        name, found = type(callback).__name__, f"{type(module).__name__} on {type(source).__name__}"
        raise ForbesError(f"{name}: found a {found}, expected an agent on Experience. Remove it, or change them")
