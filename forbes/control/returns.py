"""λ-returns: value targets of imagined trajectories (TD(λ), paper §3.2; Sutton and Barto, 2018, §12.1)."""

import torch
from torch import Tensor

__all__ = ["actor_loss", "critic_loss", "lambda_returns"]


def lambda_returns(reward: Tensor, value: Tensor, discount: float, lambda_: float) -> Tensor:
    r"""Mix the n-step returns of an imagined trajectory, backwards from its end.

    .. math:: V_\tau = r_\tau + \gamma\,[(1-\lambda)\,v_{\tau+1} + \lambda\,V_{\tau+1}],
              \qquad V_{H-1} = r_{H-1} + \gamma\,v_H

    A return pairs the reward of a state with the value of the next; H = 3::

        states    s1   s2   s3
        rewards   r1   r2            the last reward is not used
        values         v2   v3       v3 bootstraps
        returns   V1   V2

    Args:
        reward: :math:`r_\tau` of each imagined state, `(*, H)`, H at least 2.
        value: :math:`v(s_\tau)` of the same states, `(*, H)`.
        discount: :math:`\gamma` in [0, 1].
        lambda_: :math:`\lambda` in [0, 1]; 0 gives one-step targets, 1 the full return.

    Returns:
        :math:`V_\tau` of all states but the last, `(*, H - 1)`, in units of reward.
    """
    target, returns = value[..., -1], []
    for r, v in zip(reward[..., :-1].flip(-1).unbind(-1), value[..., 1:].flip(-1).unbind(-1), strict=True):
        target = r + discount * ((1 - lambda_) * v + lambda_ * target)
        returns.append(target)
    return torch.stack(returns[::-1], -1)  # (*, H - 1)


def actor_loss(returns: Tensor, discount: float, valid: Tensor) -> Tensor:
    r"""Give :math:`-\overline{\gamma^{\tau-1} V_\tau}` over trajectories and states (paper, J_Actor; weights: Dreamer).

    Args:
        returns: :math:`V_\tau`, `(*, H - 1)`, differentiable in the actions.
        discount: :math:`\gamma`.
        valid: True for trajectories that count, `(*)`: those that start on padding do not.
    """
    return -_discounted_mean(returns, discount, valid)


def critic_loss(value: Tensor, returns: Tensor, discount: float, valid: Tensor) -> Tensor:
    r"""Give :math:`\overline{\gamma^{\tau-1} \tfrac12 (v_\tau - \mathrm{sg}(V_\tau))^2}` (paper, J_Critic).

    Args:
        value: :math:`v(s_\tau)` of the states that have a return, `(*, H - 1)`.
        returns: :math:`V_\tau`, `(*, H - 1)`; they are not moved.
        discount: :math:`\gamma`.
        valid: as for `actor_loss`.
    """
    return _discounted_mean(0.5 * (value - returns.detach()).square(), discount, valid)


def _discounted_mean(values: Tensor, discount: float, valid: Tensor) -> Tensor:
    """Average over trajectories and states; one that is imagined τ - 1 steps after the first counts γ^{τ-1}."""
    weight = discount ** torch.arange(values.shape[-1], device=values.device, dtype=values.dtype)  # (H - 1,)
    return ((weight * values).mean(-1) * valid).sum() / valid.sum()
