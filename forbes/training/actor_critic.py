"""FORBES and Dreamer as a LightningModule: the world model, and an actor and a critic that learn in its imagination."""

import math
from typing import Any

from torch import Tensor

from forbes.control.imagination import belief_samples, frozen
from forbes.control.policy import Actor, ScalarHead
from forbes.control.returns import actor_loss, critic_loss, lambda_returns
from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.models import Filtered, State
from forbes.training.world_model import Group, WorldModel, require_at_least

__all__ = ["ImaginationActorCritic"]


class ImaginationActorCritic(WorldModel):
    r"""Learns to act on beliefs (paper §3.2, algorithm 1). Dreamer is the same with `GaussianBelief` and N = 1.

    Three losses, taken at the same parameters and minimised in one step; each trains its own networks only:

    .. math::

        L_{model} &= -J_{Model} - \overline{\log N(r_t; \hat r(f_t), 1)} \\
        L_{actor} &= -\overline{\gamma^{\tau-1} V_\tau}, \qquad
        L_{critic} = \overline{\gamma^{\tau-1} \tfrac12 (v(f_\tau) - \mathrm{sg}(V_\tau))^2}

    with :math:`f = [h, s]`, and λ-returns V along H imagined steps from N samples of the belief at every step of every
    sequence. Where the paper sums over N, the bar is a mean; Adam does not see the factor.

    Args:
        trajectories: N.
        horizon: H, at least 2.
        discount: :math:`\gamma`.
        lambda_: :math:`\lambda` of the returns.
        control_dim: width of actor, critic and reward.
        control_layers: hidden layers of each.
        actor_rate: learning rate of the actor.
        critic_rate: learning rate of the critic.
        **world: arguments of `WorldModel`; its learning rate is that of the model and the reward.

    Raises:
        ForbesError: when N or a size is below 1, H below 2, or the data have no actions.
    """

    def __init__(
        self,
        trajectories: int = 4,
        horizon: int = 15,
        discount: float = 0.99,
        lambda_: float = 0.95,
        control_dim: int = 200,
        control_layers: int = 2,
        actor_rate: float = 8e-5,
        critic_rate: float = 8e-5,
        **world: Any,
    ) -> None:
        super().__init__(**world)
        sizes = {"trajectories": trajectories, "control_dim": control_dim, "control_layers": control_layers}
        require_at_least(1, "ImaginationActorCritic", **sizes)
        require_at_least(2, "ImaginationActorCritic", horizon=horizon)
        require_at_least(0, "ImaginationActorCritic", actor_rate=actor_rate, critic_rate=critic_rate)
        if self.model.action_dim == 0:
            raise ForbesError(
                "ImaginationActorCritic: the data have no actions. Choose another source, or a WorldModel"
            )
        features = self.model.hidden_dim + self.model.state_dim
        self.reward = ScalarHead(features, control_dim, control_layers)
        self.actor = Actor(features, self.model.action_dim, control_dim, control_layers)
        self.critic = ScalarHead(features, control_dim, control_layers)
        self.trajectories, self.horizon, self.discount, self.lambda_ = trajectories, horizon, discount, lambda_
        self.actor_rate, self.critic_rate = actor_rate, critic_rate

    def training_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Give the sum of the three losses of one update; their gradients do not overlap."""
        filtered = self.model.filter(self.model.embed(batch.observation), batch.action)
        terms = self.model.bound(filtered, batch.observation, batch.mask)
        reward = _log_normal(self.reward(filtered.features), batch.reward)  # (B, T)
        model_loss = self.loss(terms) - terms.mean_over_steps(reward)
        actor, critic = self._control_losses(filtered, batch.mask)
        self._log("train", terms)
        self.log_dict(
            {
                "train/reward": terms.mean_over_steps(reward).detach(),
                "train/actor_loss": actor.detach(),
                "train/critic_loss": critic.detach(),
            }
        )
        return model_loss + actor + critic

    def _control_losses(self, filtered: Filtered, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Imagine from every belief; give the losses of actor and critic."""
        samples = belief_samples(self.model, filtered, self.trajectories)
        start = State(*(values.flatten(0, 2) for values in samples))  # (N B T, …)
        valid = mask.expand(self.trajectories, -1, -1).flatten()  # (N B T,)
        with frozen(self.model, self.reward, self.critic):
            policy = lambda features: self.actor(features.detach()).rsample()[0]  # noqa: E731
            features = self.model.roll(start, policy, self.horizon).features  # (N B T, H, F)
            returns = lambda_returns(self.reward(features), self.critic(features), self.discount, self.lambda_)
        value = self.critic(features[:, :-1].detach())  # (N B T, H - 1)
        return actor_loss(returns, self.discount, valid), critic_loss(value, returns, self.discount, valid)

    def groups(self) -> list[Group]:
        """See `WorldModel.groups`: three, so that no gradient is scaled down for another's sake."""
        model = [*self.model.parameters(), *self.reward.parameters()]
        return [
            Group("model", model, self.learning_rate),
            Group("actor", [*self.actor.parameters()], self.actor_rate),
            Group("critic", [*self.critic.parameters()], self.critic_rate),
        ]


def _log_normal(mean: Tensor, value: Tensor) -> Tensor:
    """Give log N(value; mean, 1) in nats."""
    return -0.5 * ((value - mean).square() + math.log(2 * math.pi))
