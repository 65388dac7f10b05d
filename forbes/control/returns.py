"""λ-returns: value targets of imagined trajectories (TD(λ), paper §3.2; Sutton and Barto, 2018, §12.1)."""

import torch
from torch import Tensor

from forbes.performance.fusion import fused

__all__ = ["actor_loss", "critic_loss", "lambda_returns"]


@fused
def lambda_returns(reward: Tensor, value: Tensor, discount: Tensor, lambda_: float) -> Tensor:
    r"""Mix the n-step returns of an imagined trajectory, backwards from its end.

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
        discount: :math:`\gamma_\tau` in [0, 1], what the next reward counts in that state, `(*, H)`; H alone will do.
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
        discount: :math:`\gamma_\tau`, as for `lambda_returns`; the weights do not train it.
        valid: True for trajectories that count, `(*)`: those that start on padding do not.
    """
    return -_discounted_mean(returns, discount, valid)


def critic_loss(value: Tensor, returns: Tensor, discount: Tensor, valid: Tensor) -> Tensor:
    r"""Return :math:`\overline{w_\tau \tfrac12 (v_\tau - \mathrm{sg}(V_\tau))^2}` (paper, J_Critic).

    Args:
        value: :math:`v(s_\tau)` of the states that have a return, `(*, H - 1)`.
        returns: :math:`V_\tau`, `(*, H - 1)`; they are not moved.
        discount: as for `actor_loss`.
        valid: as for `actor_loss`.
    """
    return _discounted_mean(0.5 * (value - returns.detach()).square(), discount, valid)


@fused
def _discounted_mean(values: Tensor, discount: Tensor, valid: Tensor) -> Tensor:
    """Average over trajectories and states; the first counts 1, each other what the discounts before it leave."""
    first = torch.ones_like(discount[..., :1])
    weight = torch.cat((first, discount.detach()[..., :-2]), -1).cumprod(-1)  # (*, H - 1)
    return ((weight * values).mean(-1) * valid).sum() / valid.sum()
