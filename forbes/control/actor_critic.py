r"""Algorithm 1: actor and critic learn in imagination (paper §3.2; Dreamer, Hafner et al., 2020, arXiv 1912.01603).

1. `sample_starts`: draw N samples of the belief at every step of every sequence.
2. `imagine`: the actor acts from each of them for H steps, in the world model.
3. `lambda_returns`: mix rewards and values into the targets V.
4. `actor_loss` and `critic_loss`: raise V by the actions, and regress the critic on V.

`actor_critic_losses` does all four. The start is not among the imagined states. The action that the policy takes in a
state leads to the next, and the reward that comes with it belongs to that next state, as it does in stored sequences.
H = 3::

    states       s0 --a0--> s1 --a1--> s2 --a2--> s3
    rewards                 r1         r2         r3
    values                  v1         v2         v3
    returns                 V1         V2                 V1 = r1 + γ[(1 - λ) v2 + λ V2],  V2 = r2 + γ v3
"""

from typing import NamedTuple

import torch
from torch import Tensor

from forbes.control.policy import Actor, Policy, ScalarHead
from forbes.control.return_scale import ReturnScale
from forbes.distributed import masked_sums
from forbes.frozen import frozen
from forbes.models import Filtered, State, StateSpaceModel
from forbes.performance.fusion import fused
from forbes.performance.precision import full_precision
from forbes.shapes import printed_by_shape

__all__ = [
    "ActorCritic",
    "Imagined",
    "ImaginedWorld",
    "actor_critic_losses",
    "actor_loss",
    "critic_loss",
    "imagine",
    "lambda_returns",
    "sample_starts",
]


class ImaginedWorld(NamedTuple):
    """What is learned from data and answers for the environment in imagination."""

    model: StateSpaceModel
    reward: ScalarHead
    continuation: ScalarHead | None
    """The logit of p(c = 1 | f), that an episode continues after a state; None where no episode ends by itself."""

    def discount(self, features: Tensor, discount: float) -> Tensor:
        r"""Return :math:`\gamma_\tau = \gamma\,p(c_\tau = 1 \mid f_\tau)`, `(*, H, F)` to `(*, H)`, or γ as `(H,)`."""
        if self.continuation is None:
            return features.new_full(features.shape[-2:-1], discount)  # (H,)
        continues: Tensor = self.continuation(features).sigmoid()  # (*, H)
        return discount * continues


class ActorCritic(NamedTuple):
    """What learns in imagination. The last two are DreamerV3's (arXiv 2301.04104)."""

    actor: Actor
    """The policy π."""
    critic: ScalarHead
    """The value v of features."""
    slow_critic: ScalarHead | None = None
    """A moving average of the critic, to which the critic is held."""
    return_scale: ReturnScale | None = None
    """By which the returns are divided in the actor's loss."""


@printed_by_shape
class Imagined(NamedTuple):
    """M imagined trajectories of H states."""

    features: Tensor
    """[h, s] of the states, `(M, H, F)`."""
    log_prob: Tensor
    """log π(a) in nats of the action that led to each state, `(M, H)`."""


def actor_critic_losses(
    world: ImaginedWorld,
    learner: ActorCritic,
    filtered: Filtered,
    start_mask: Tensor,
    *,
    trajectories: int,
    horizon: int,
    discount: float,
    lambda_: float,
    actor_entropy: float,
) -> tuple[Tensor, Tensor]:
    r"""Imagine from beliefs, and return the losses of actor and critic.

    .. math::

        L_{actor} = -\overline{w_\tau (V_\tau / S - \eta \log \pi(a_{\tau-1}))}, \qquad
        L_{critic} = \overline{w_\tau [E(v(f_\tau), \mathrm{sg}(V_\tau)) + E(v(f_\tau), v_{slow}(f_\tau))]}

    E is the critic's error, half the square of the difference for a `ScalarHead`. S is 1 without a `return_scale`, and
    the last term is only there with a `slow_critic`. Each loss has gradients with respect to its own network only.

    Args:
        world: model, rewards and ends of episodes; it is not trained here.
        learner: actor and critic.
        filtered: the beliefs along B sequences of T steps.
        start_mask: which of them an imagined trajectory starts from, bool `(B, T)`. The others do not count.
        trajectories: samples of each belief, N.
        horizon: imagined steps, H, at least 2.
        discount: :math:`\gamma`.
        lambda_: :math:`\lambda` of the returns.
        actor_entropy: :math:`\eta`, the reward of a nat of the policy's entropy.

    Returns:
        The actor's loss in units of reward, or of S, and the critic's in those of its error, scalars.
    """
    start = State(*(values.flatten(0, 2) for values in sample_starts(world.model, filtered, trajectories)))
    valid = start_mask.expand(trajectories, -1, -1).flatten()  # (M,), M = N B T

    # Gradients pass through the world and the critic to the actions, and train neither.
    with frozen(*filter(None, world), learner.critic):
        imagined = imagine(world.model, learner.actor, start, horizon)
        discounts = world.discount(imagined.features, discount)  # (M, H) or (H,)
        reward, target = world.reward(imagined.features), learner.critic(imagined.features)  # 2 x (M, H)
        returns = lambda_returns(reward, target, discounts, lambda_)  # (M, H - 1)

    seen = imagined.features[:, :-1].detach()  # (M, H - 1, F)
    error = learner.critic.error(seen, returns.detach())  # (M, H - 1)
    if learner.slow_critic is not None:
        error = error + learner.critic.error(seen, learner.slow_critic(seen).detach())  # (M, H - 1)
    loss_of_critic = critic_loss(error, discounts, valid)
    if learner.return_scale is not None:
        returns = returns / learner.return_scale(returns, valid)  # (M, H - 1)
    if actor_entropy:  # a gradient of zeros would cost 3 % of the imagination
        returns = returns - actor_entropy * imagined.log_prob[:, :-1]  # (M, H - 1)
    return actor_loss(returns, discounts, valid), loss_of_critic


def sample_starts(model: StateSpaceModel, filtered: Filtered, trajectories: int) -> State:
    """Return N samples of the belief at each step of each sequence, without gradients: `(N, B, T, …)`.

    The first is the filter's own trajectory, so that N = 1 is Dreamer.
    """
    with full_precision(filtered.context):
        more, _ = model.posterior.rsample(filtered.context, (trajectories - 1,))  # (N - 1, B, T, D)
    state = torch.cat((filtered.state[None], more)).detach()  # (N, B, T, D)
    return State(filtered.hidden.detach().expand(trajectories, -1, -1, -1), state)


def imagine(model: StateSpaceModel, actor: Actor, start: State, horizon: int) -> Imagined:
    """Let the actor act in the world model for H steps, differentiably in its actions.

    The actor learns what its actions lead to, not to reach states in which it would choose others: its input has no
    gradient.

    Args:
        model: the dynamics; its prior draws the next state.
        actor: the policy.
        start: M states, `(M, …)`.
        horizon: H.
    """
    state = start
    steps: list[tuple[Tensor, Tensor, Tensor]] = []
    with full_precision(start.state):
        step = model.prepare_imagination(len(start.state), horizon)
        for _ in range(horizon):
            policy: Policy = actor(torch.cat(state, -1).detach())
            action, log_prob = policy.rsample()  # (M, A), (M,)
            state, _ = step(state, action)
            steps.append((*state, log_prob))
    hidden, drawn, log_prob = (torch.stack(values, 1) for values in zip(*steps, strict=True))  # (M, H, …)
    return Imagined(torch.cat((hidden, drawn), -1), log_prob)


@fused
def lambda_returns(reward: Tensor, value: Tensor, discount: Tensor, lambda_: float) -> Tensor:
    r"""Mix the n-step returns of an imagined trajectory, backwards from its end (TD(λ); Sutton and Barto, 2018, §12.1).

    .. math:: V_\tau = r_\tau + \gamma_\tau\,[(1-\lambda)\,v_{\tau+1} + \lambda\,V_{\tau+1}],
              \qquad V_{H-1} = r_{H-1} + \gamma_{H-1}\,v_H

    A return pairs the reward of a state with the value of the next; H = 3::

        states    s1   s2   s3
        rewards   r1   r2            the last reward is not used
        discounts γ1   γ2            0 after a state in which the episode ends
        values         v2   v3       v3 bootstraps
        returns   V1   V2

    Args:
        reward: :math:`r_\tau` of each imagined state, `(*, H)`, H at least 2.
        value: :math:`v(s_\tau)` of the same states, `(*, H)`.
        discount: :math:`\gamma_\tau` in [0, 1], the weight of the next reward in that state, `(*, H)` or `(H,)`.
        lambda_: :math:`\lambda` in [0, 1]; 0 gives one-step targets, 1 the full return.

    Returns:
        :math:`V_\tau` of all states but the last, `(*, H - 1)`, in units of reward.
    """
    target, returns = value[..., -1], []
    backwards = (x.flip(-1).unbind(-1) for x in (reward[..., :-1], discount[..., :-1], value[..., 1:]))
    for r, g, v in zip(*backwards, strict=True):
        target = r + g * ((1 - lambda_) * v + lambda_ * target)
        returns.append(target)
    return torch.stack(returns[::-1], -1)  # (*, H - 1)


def actor_loss(returns: Tensor, discount: Tensor, valid: Tensor) -> Tensor:
    r"""Return :math:`-\overline{w_\tau V_\tau}` over trajectories and states (paper, J_Actor; weights: Dreamer).

    .. math:: w_\tau = \textstyle\prod_{k < \tau} \gamma_k

    Args:
        returns: :math:`V_\tau`, `(*, H - 1)`, differentiable in the actions.
        discount: :math:`\gamma_\tau`, as for `lambda_returns`. The weights have no gradient.
        valid: True for trajectories that count, `(*)`. Those that start on padding do not.
    """
    return -_discounted_mean(returns, discount, valid)


def critic_loss(error: Tensor, discount: Tensor, valid: Tensor) -> Tensor:
    r"""Return :math:`\overline{w_\tau E_\tau}`; in the paper, :math:`E = \tfrac12 (v_\tau - \mathrm{sg}(V_\tau))^2`.

    Args:
        error: E of the values of the states that have a return, `(*, H - 1)`; see `ScalarHead.error`.
        discount: as for `actor_loss`.
        valid: as for `actor_loss`.
    """
    return _discounted_mean(error, discount, valid)


@fused
def _discounted_mean(values: Tensor, discount: Tensor, valid: Tensor) -> Tensor:
    """Average over trajectories and states. The weight of a state is the product of the discounts before it."""
    first = torch.ones_like(discount[..., :1])
    weight = torch.cat((first, discount.detach()[..., :-2]), -1).cumprod(-1)  # (*, H - 1)
    total, count = masked_sums((weight * values).mean(-1), valid)
    return total / count
