r"""How unsure an agent's belief is of the reward that came with what it has just seen, where the exact belief is known.

.. math:: u = \frac{\sum_t \operatorname{Var}[\hat r(f_t)]}{\sum_t \operatorname{Var}[r(s_{t-1}, a_{t-1}, s_t)]}, \qquad
          f_t \sim q(\cdot \mid o_{1:t}, a_{1:t-1}), \quad s_{t-1:t} \sim p(\cdot \mid o_{1:t}, a_{1:t-1})

A learned state is its own and cannot be held against the process's, but the reward is a function of either. 1 is as
unsure as one can know to be. 0 is a model whose draws all say the same: what it does not know is not in its belief, so
no shape of it can matter, nor imagining from many draws.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from forbes.data.episodes import Episode
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.followed import followed
from forbes.pomdps import Process
from forbes.seeding import generator
from forbes.training.acting import ActingModel

__all__ = ["DRAWS", "exact_variance", "learned_variance", "uncertainty"]

DRAWS = 256
"""Of either belief."""


def exact_variance(process: Process, episode: Episode, seed: int) -> Tensor:
    r"""Return the variance of each reward under the exact belief, by draws that are weighed by what was seen.

    .. math:: s_{t-1}^k \sim p(\cdot \mid o_{1:t-1}, a_{1:t-2}), \quad
              s_t^k \sim p(\cdot \mid s_{t-1}^k, a_{t-1}), \quad w_t^k \propto p(o_t \mid s_t^k)

    Args:
        process: the one the episode was played in.
        episode: of T actions, each in [-1, 1] or one-hot.
        seed: of the draws.

    Returns:
        In squared units of reward, float64 `(T,)`.
    """
    draw = generator(seed, "reward", 0)
    observation = torch.from_numpy(episode.observation.copy()).double()[None]  # (1, T + 1, O)
    action = process.action_scale * torch.from_numpy(episode.action.copy()).double()[None]  # (1, T + 1, A)
    before = process.exact_filter(observation, action).belief.sample(DRAWS, draw)[:, 0, :-1]  # (K, T, D)
    after = process.transition(before, action[0, 1:]).sample(1, draw).squeeze(0)  # (K, T, D)
    weight = process.emission(after).log_prob(observation[0, 1:]).softmax(0)  # (K, T)
    reward = process.reward(before, action[0, 1:], after)  # (K, T)
    mean = (weight * reward).sum(0)  # (T,)
    return (weight * (reward - mean).square()).sum(0)


def learned_variance(agent: ActingModel, episode: Episode, seed: int) -> Tensor:
    """Return the variance of each reward over trajectories of an agent's belief, in squared units of reward, `(T,)`."""
    with followed(agent, episode, DRAWS, seed) as (filtered, _):
        reward: Tensor = agent.reward(filtered.features)[:, 1:]  # (S, T)
        return reward.double().var(0).cpu()


def uncertainty(learned: Sequence[Tensor], exact: Sequence[Tensor]) -> Estimate:
    """Return u of E episodes, at least 2, with the error of a ratio over them."""
    sums = (torch.stack([one.sum() for one in variances]) for variances in (learned, exact))  # 2 x (E,)
    return Estimate.per_step(*sums)
