"""FORBES and Dreamer as a LightningModule: a world model, and an actor and a critic that learn in its imagination."""

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from forbes.control.actor_critic import ActorCritic, ImaginedWorld, actor_critic_losses
from forbes.control.agent import ActionSelector, explore, greedy
from forbes.control.policy import Actor, ScalarHead
from forbes.control.return_scale import ReturnScale
from forbes.data import SequenceBatch
from forbes.errors import ForbesError, require_at_least
from forbes.models import Filtered
from forbes.models.networks import activate
from forbes.training.acting import WorldModelAgent
from forbes.training.seeded import Group
from forbes.training.world_model import LossTerm

__all__ = ["ImaginationActorCritic"]


class ImaginationActorCritic(WorldModelAgent):
    r"""Learns to act on beliefs (paper §3.2, algorithm 1). Dreamer is the same with `GaussianBelief` and N = 1.

    An update minimises three losses in one step; each trains its own networks only
    (`control/actor_critic.py` has the algorithm):

    .. math::

        L_{model} = -J_{Model} - \overline{\log p(r_t \mid f_t)}, \qquad
        L_{actor} = -\overline{w_\tau (V_\tau - \eta \log \pi(a_{\tau-1}))}, \qquad
        L_{critic} = \overline{w_\tau \tfrac12 (v(f_\tau) - \mathrm{sg}(V_\tau))^2}

    with the features :math:`f = [h, s]`, the λ-returns V along H imagined steps from N samples of the belief at every
    step of every sequence, and :math:`w_\tau = \gamma^{\tau-1}`. The bar is a mean also over N, where the paper has a
    sum; Adam does not depend on this factor. For discrete actions the policy is categorical, or a product of
    categoricals, with straight-through gradients.

    With `continuation`, :math:`L_{model}` has the additional term :math:`-\overline{\log p(c_t \mid f_t)}`, where
    :math:`c_t` is 0 if the episode terminated in step t, else 1. The discounts are then
    :math:`\gamma_\tau = \gamma\,p(c_\tau = 1 \mid f_\tau)`, the weights :math:`w_\tau = \prod_{k<\tau} \gamma_k`,
    and trajectories that start where an episode has terminated do not count (Dreamer's `pcont`, off in its published
    runs and in the paper).

    `two_hot`, `scale_returns` and `slow_critic` are of DreamerV3 (arXiv 2301.04104), off by default.

    Args:
        trajectories: imagined trajectories per belief, N.
        horizon: imagined steps, H, at least 2.
        discount: discount factor :math:`\gamma`.
        lambda_: :math:`\lambda` of the returns.
        control_dim: width of actor, critic and reward.
        actor_entropy: :math:`\eta`, the reward of a nat of entropy (DreamerV2, arXiv 2010.02193), 0 in paper and
            Dreamer. It lets an actor return from the border of the action space, where an early model may drive it.
        actor_min_std: :math:`\sigma_{min}` of the actor before its tanh. At Dreamer's 1e-4 an actor may become
            deterministic and stop exploring; DreamerV2's is 0.1.
        continuation: learn where episodes terminate; needed where they do so other than by a time limit.
        actor_layers: hidden layers of the actor.
        critic_layers: hidden layers of the critic.
        scale_returns: divide the returns in the actor's loss by their running range, see `ReturnScale`.
        slow_critic: share of the critic that its moving average takes on in an update, 0.02 in DreamerV3. The critic is
            held to it: :math:`L_{critic}` also has its error with the average's value as the target. 0 for none.
        actor_rate: learning rate of the actor.
        critic_rate: learning rate of the critic.
        **acting: arguments of `WorldModelAgent` and `WorldModel`, whose learning rate is that of model and reward.

    Raises:
        ForbesError: when N or a size is below 1, H below 2, `discount`, `lambda_` or `slow_critic` not in [0, 1], or
            the data have no actions.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Experience("mountain_hike"), length=30, batch_size=20)
        >>> agent = forbes.ImaginationActorCritic.for_data(data, trajectories=4, horizon=10)
        >>> agent.model.action_dim, agent.discrete
        (2, False)
        >>> data.source.close()
    """

    def __init__(
        self,
        trajectories: int = 4,
        horizon: int = 15,
        discount: float = 0.99,
        lambda_: float = 0.95,
        control_dim: int = 200,
        actor_entropy: float = 0.0,
        actor_min_std: float = 1e-4,
        continuation: bool = False,
        actor_layers: int = 2,
        critic_layers: int = 2,
        scale_returns: bool = False,
        slow_critic: float = 0.0,
        actor_rate: float = 8e-5,
        critic_rate: float = 8e-5,
        **acting: Any,
    ) -> None:
        super().__init__(control_dim, **acting)
        name = type(self).__name__
        require_at_least(1, name, trajectories=trajectories, actor_layers=actor_layers, critic_layers=critic_layers)
        require_at_least(2, name, horizon=horizon)
        require_at_least(0, name, actor_rate=actor_rate, critic_rate=critic_rate, actor_entropy=actor_entropy)
        for shared, value in (("discount", discount), ("lambda_", lambda_), ("slow_critic", slow_critic)):
            if not 0 <= value <= 1:
                raise ForbesError(f"{name}: {shared} is {value}, expected 0 to 1")
        if not actor_min_std > 0:
            raise ForbesError(f"{name}: actor_min_std is {actor_min_std}, expected a number above 0. 1e-4 is Dreamer's")
        features = self.model.hidden_dim + self.model.state_dim
        self.actor = Actor(features, self.model.action_dim, control_dim, actor_layers, self.discrete, actor_min_std)
        self.critic = self.scalar_head(features, control_dim, critic_layers)
        self.continues = ScalarHead(features, control_dim, self.reward_layers) if continuation else None
        for network in filter(None, (self.actor, self.critic, self.continues)):
            activate(network, self.activation)
        self.slow_critic = copy.deepcopy(self.critic).requires_grad_(False) if slow_critic else None
        self.slow_critic_rate = slow_critic
        self.return_scale = ReturnScale() if scale_returns else None
        self.trajectories, self.horizon, self.discount, self.lambda_ = trajectories, horizon, discount, lambda_
        self.actor_rate, self.critic_rate, self.actor_entropy = actor_rate, critic_rate, actor_entropy

    @property
    def predicts_termination(self) -> bool:
        """See `WorldModelAgent.predicts_termination`."""
        return self.continues is not None

    def action_selector(self, exploring: bool) -> ActionSelector:
        """See `WorldModelAgent.action_selector`: a sample with noise, or the mode."""
        return explore(self.actor, self.exploration) if exploring else greedy(self.actor)

    def loss_terms(self, batch: SequenceBatch) -> list[Callable[[], LossTerm]]:
        """See `WorldModel.loss_terms`: that of the model, and that of actor and critic."""
        encoded, filtered = self.follow(batch)
        return [
            lambda: self.model_loss(filtered, encoded, batch),
            lambda: self.control_loss(filtered, batch.mask & ~batch.ended),
        ]

    def log_probs(self, filtered: Filtered, batch: SequenceBatch) -> dict[str, Tensor]:
        """See `WorldModelAgent.log_probs`; with `continuation`, log p(c_t | f_t) too."""
        found = super().log_probs(filtered, batch)
        if self.continues is not None:
            sign = torch.where(batch.ended, -1.0, 1.0)  # (B, T)
            found["continuation"] = logsigmoid(sign * self.continues(filtered.features))  # (B, T)
        return found

    def control_loss(self, filtered: Filtered, start_mask: Tensor) -> LossTerm:
        """Return the sum of the losses of actor and critic, and both of them to log."""
        actor, critic = self.control_losses(filtered, start_mask)
        return LossTerm(actor + critic, {"actor_loss": actor.detach(), "critic_loss": critic.detach()})

    def control_losses(self, filtered: Filtered, start_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses of actor and critic along B sequences of T beliefs, see `actor_critic_losses`.

        Args:
            filtered: the beliefs, `(B, T, …)`.
            start_mask: which of them an imagined trajectory starts from, bool `(B, T)`.
        """
        return actor_critic_losses(
            ImaginedWorld(self.model, self.reward, self.continues),
            ActorCritic(self.actor, self.critic, self.slow_critic, self.return_scale),
            filtered,
            start_mask,
            trajectories=self.trajectories,
            horizon=self.horizon,
            discount=self.discount,
            lambda_=self.lambda_,
            actor_entropy=self.actor_entropy,
        )

    @torch.no_grad()
    def on_train_batch_end(self, outputs: Any, batch: SequenceBatch, batch_idx: int) -> None:
        """Move the critic's moving average towards it."""
        if self.slow_critic is not None:
            for average, parameter in zip(self.slow_critic.parameters(), self.critic.parameters(), strict=True):
                average.lerp_(parameter, self.slow_critic_rate)

    def groups(self) -> list[Group]:
        """See `SeededModule.groups`: three, so that clipping one gradient does not shrink the others."""
        world = filter(None, (self.model, self.reward, self.continues))
        return [
            Group("model", [p for part in world for p in part.parameters()], self.learning_rate),
            Group("actor", [*self.actor.parameters()], self.actor_rate),
            Group("critic", [*self.critic.parameters()], self.critic_rate),
        ]
