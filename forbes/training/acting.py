"""What agents share: a world model that predicts rewards too, and a selection of actions."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor

from forbes.control.agent import ActionSelector, Agent
from forbes.control.policy import ScalarHead, TwoHotHead
from forbes.data import SequenceBatch, SequenceDataModule
from forbes.data.episodes.collection import episode_seed, play_whole
from forbes.data.episodes.episode import Episode
from forbes.densities import log_normal
from forbes.envs import Environment
from forbes.errors import ForbesError, require_at_least
from forbes.factors import Discrete, problem_of_discrete
from forbes.models import EncodedSequence, Filtered, StateSpaceModel
from forbes.models.networks import activate
from forbes.training.world_model import LossTerm, WorldModel

__all__ = ["AgentPolicy", "WorldModelAgent", "play_measured"]


class WorldModelAgent(WorldModel, ABC):
    r"""A world model with rewards: :math:`p(r_t \mid f_t) = N(\hat r(f_t), \sigma_r^2)` with the features `f = [h, s]`.

    .. math:: L_{model} = -J_{Model} - \overline{\log p(r_t \mid f_t)}

    With `two_hot`, :math:`\log p(r_t \mid f_t)` is that of the reward's two-hot code (`TwoHotHead`), a probability, and
    not a density.

    Args:
        control_dim: width of the MLPs of reward, actor and critic.
        reward_layers: hidden layers of the reward's MLP.
        reward_std: :math:`\sigma_r`; values below 1 weight the reward more. PlaNet's scale of 10 is 0.32.
        two_hot: predict rewards, and values, by a categorical over fixed bins (DreamerV3), for any scale of them.
        exploration: standard deviation of the noise on the actions of collected episodes; for discrete actions the
            probability of a uniformly random one.
        discrete: whether an action is one of A, one-hot; or the sizes of several one-hot factors. The command line
            takes it from the data.
        acting_samples: trajectories of the belief whose mean action the agent takes, K (see `Agent`); 1 in the paper.
            It can be changed after a training.
        **world: arguments of `WorldModel`.

    Raises:
        ForbesError: when a size is below 1, `exploration` below 0, `reward_std` not above 0, or the data have no
            actions.
    """

    def __init__(
        self,
        control_dim: int = 200,
        reward_layers: int = 2,
        reward_std: float = 1.0,
        two_hot: bool = False,
        exploration: float = 0.3,
        discrete: Discrete = False,
        acting_samples: int = 1,
        **world: Any,
    ) -> None:
        super().__init__(**world)
        name = type(self).__name__
        require_at_least(1, name, control_dim=control_dim, reward_layers=reward_layers, acting_samples=acting_samples)
        require_at_least(0, name, exploration=exploration)
        if not reward_std > 0:
            raise ForbesError(f"{name}: reward_std is {reward_std}, expected a number above 0. 1 is Dreamer's")
        if two_hot and reward_std != 1:
            raise ForbesError(f"{name}: reward_std is {reward_std} with two_hot, which has none. Leave one of them out")
        if type(self.model) is not StateSpaceModel:
            raise ForbesError(
                f"{name}: its model is a {type(self.model).__name__}, expected a StateSpaceModel. Name none"
            )
        self.model: StateSpaceModel
        if self.model.action_dim == 0:
            raise ForbesError(
                f"{name}: the data have no actions, expected some. Choose another source, or a WorldModel"
            )
        if problem := problem_of_discrete(discrete, self.model.action_dim):
            raise ForbesError(f"{name}: {problem}. Use that of the data")
        self.exploration, self.discrete, self.acting_samples = exploration, discrete, acting_samples
        self.reward_std, self.reward_layers = reward_std, reward_layers
        self.scalar_head = TwoHotHead if two_hot else ScalarHead
        self.reward = self.scalar_head(self.model.hidden_dim + self.model.state_dim, control_dim, reward_layers)
        activate(self.reward, self.activation)

    @classmethod
    def for_data(cls, data: SequenceDataModule, **options: Any) -> Self:
        """See `WorldModel.for_data`. The kind of actions is also taken from the data."""
        return super().for_data(data, **({"discrete": data.discrete} | options))

    @property
    def predicts_termination(self) -> bool:
        """Whether it learns where episodes terminate (a time limit is no termination)."""
        return False

    @abstractmethod
    def action_selector(self, exploring: bool) -> ActionSelector:
        """Return how to act: with exploration, to collect data, or greedily, to be evaluated."""

    def loss_terms(self, batch: SequenceBatch) -> list[Callable[[], LossTerm]]:
        """See `WorldModel.loss_terms`: that of the world model."""
        encoded, filtered = self.follow(batch)
        return [lambda: self.model_loss(filtered, encoded, batch)]

    def follow(self, batch: SequenceBatch) -> tuple[EncodedSequence, Filtered]:
        """Encode a batch, and draw a trajectory of the posterior along it."""
        encoded = self.model.encode(batch.observation, batch.action)
        return encoded, self.model.filter(encoded.embedding, encoded.action)

    def model_loss(self, filtered: Filtered, encoded: EncodedSequence, batch: SequenceBatch) -> LossTerm:
        """Return the loss of model and reward along a trajectory, in nats per step."""
        terms = self.model.bound(filtered, encoded, batch.mask, self.kl)
        means = {name: terms.mean_over_steps(values) for name, values in self.log_probs(filtered, batch).items()}
        loss = self.loss(terms) - sum(means.values())
        return LossTerm(loss, self.measures(terms) | {name: mean.detach() for name, mean in means.items()})

    def log_probs(self, filtered: Filtered, batch: SequenceBatch) -> dict[str, Tensor]:
        """Return what the model predicts in addition to observations, by name: log p(r_t | f_t) in nats, `(B, T)`."""
        if isinstance(self.reward, TwoHotHead):
            return {"reward": -self.reward.error(filtered.features, batch.reward)}
        return {"reward": log_normal(batch.reward, self.reward(filtered.features), self.reward_std)}


@dataclass(frozen=True)
class AgentPolicy:
    """Makes the policy by which an agent plays an episode: a `MakePolicy` that can be pickled."""

    agent: WorldModelAgent
    exploring: bool

    @classmethod
    def as_it_is(cls, agent: WorldModelAgent, exploring: bool) -> Self:
        """Copy an agent to the CPU, in eval mode, and without its `recorded` update, which belongs to one process."""
        shallow = copy.copy(agent)
        shallow.recorded = None
        return cls(copy.deepcopy(shallow).cpu().eval(), exploring)

    def __call__(self, environment: Environment, seed: int) -> Agent:
        """See `MakePolicy`."""
        return Agent(self.agent.model, self.agent.action_selector(self.exploring), seed, self.agent.acting_samples)


def play_measured(agent: WorldModelAgent, environment: Environment, purpose: str, seed: int, number: int) -> Episode:
    """Play an episode without exploration. It is a function of purpose, seed, number and the weights.

    Args:
        agent: the agent, in eval mode.
        environment: the environment it acts in.
        purpose: name mixed into the seed, so that these episodes differ from all others of the same seed.
        seed: random seed of the measurement.
        number: number of the episode.

    Raises:
        ForbesError: when the environment fails three times.
    """
    return play_whole(environment, AgentPolicy(agent, exploring=False), episode_seed(seed, number, purpose), number)
