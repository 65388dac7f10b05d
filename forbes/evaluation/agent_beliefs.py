r"""Measures of an agent's belief along episodes: its distance from a Gaussian, and its uncertainty about rewards.

**Distance from a Gaussian**, which tells whether the flexibility of the family is used:

.. math:: \mathrm{KL}\left(q(\cdot \mid c) \,\|\, N(\mu_q, \Sigma_q)\right)
          = E_q \log q + \tfrac12 \log\det(2 \pi e\, \Sigma_q)

with the belief's own mean and covariance, which give the nearest Gaussian. If it is near 0, a Gaussian with full
covariance would do as well.

**Reward uncertainty**, the belief's uncertainty about the reward that came with its last observation, relative to that
of the exact belief:

.. math:: u = \frac{\sum_t \operatorname{Var}[\hat r(f_t)]}{\sum_t \operatorname{Var}[r(s_{t-1}, a_{t-1}, s_t)]}, \qquad
          f_t \sim q(\cdot \mid o_{1:t}, a_{1:t-1}), \quad s_{t-1:t} \sim p(\cdot \mid o_{1:t}, a_{1:t-1})

A learned state cannot be compared with the state of the process, but the reward is a function of either. The optimum is
1. At 0 all samples of the model agree: its uncertainty is not in its belief, so neither the belief's shape nor
imagination from many samples can make a difference.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from forbes.beliefs import BeliefHead, CategoricalBelief
from forbes.data.episodes.episode import Episode
from forbes.evaluation.estimates import Estimate
from forbes.models import Filtered
from forbes.pomdps import Process
from forbes.rounding import ceil_div
from forbes.seeding import derive_seed, forked, generator
from forbes.shapes import map_parts
from forbes.training.acting import WorldModelAgent

__all__ = ["DRAWS", "exact_variance", "filter_episode", "learned_variance", "non_gaussianity", "prior_and_posterior"]
__all__ += ["uncertainty"]

DRAWS = 256
"""Number of samples of each belief for the reward uncertainty."""
_ROUNDING = 1e-20
"""Sums of variances below this are errors of rounding, in squared units of reward."""
_DRAWS = 1024
_STEPS = 64
"""Maximal number of steps per episode for the distance from a Gaussian, evenly spaced."""


@contextmanager
def filter_episode(
    agent: WorldModelAgent, episode: Episode, samples: int, seed: int
) -> Iterator[tuple[Filtered, Tensor]]:
    """Filter an episode. The seed also fixes samples drawn inside the `with` block; the global generator is restored.

    Args:
        agent: agent in eval mode.
        episode: episode of T actions.
        samples: number of posterior trajectories, S.
        seed: random seed for all samples.

    Yields:
        S trajectories of T + 1 steps, and the actions that were taken, `(T + 1, A)`, without gradients.
    """
    device = next(agent.parameters()).device
    observation = map_parts(lambda array: torch.from_numpy(array.copy()).to(device)[None], episode.observation)
    action = torch.from_numpy(episode.action.copy()).to(device)  # (T + 1, A)
    with torch.no_grad(), forked(device, seed):
        embedding = agent.model.embed(observation).expand(samples, -1, -1)  # (S, T + 1, E)
        yield agent.model.filter(embedding, action.expand(samples, -1, -1)), action


def non_gaussianity(head: BeliefHead, context: Tensor) -> Tensor:
    r"""Estimate the KL of beliefs from the Gaussians with their moments, by sampling; unbiased for Gaussian beliefs.

    S is the covariance of n samples. The digamma terms correct the bias of its :math:`\log\det`, known from the Wishart
    distribution:

    .. math:: \overline{\log q} + \tfrac12 \left(D \log 2\pi + D + \log\det S
              - \sum_{i=1}^D \psi\left(\tfrac{n-i}2\right) - D \log \tfrac2{n-1}\right)

    Args:
        head: belief family of a continuous state.
        context: conditioning vector c, `(*, C)`.

    Returns:
        KL in nats, float64 `(*)`.
    """
    state, log_prob = head.rsample(context, (_DRAWS,))  # (n, *, D), (n, *)
    centred = (state - state.mean(0)).double()
    covariance = torch.einsum("n...i,n...j->...ij", centred, centred) / (_DRAWS - 1)  # (*, D, D)
    dim = head.state_dim
    degrees = (_DRAWS - torch.arange(1, dim + 1, dtype=torch.float64, device=context.device)) / 2  # (D,)
    shift = degrees.digamma().sum() + dim * math.log(2 / (_DRAWS - 1))
    entropy_of_gaussian = (dim * math.log(2 * math.pi) + dim + covariance.logdet() - shift) / 2  # (*)
    kl: Tensor = log_prob.double().mean(0) + entropy_of_gaussian
    return kl


def prior_and_posterior(agent: WorldModelAgent, episode: Episode, seed: int) -> Tensor | None:
    """Average `non_gaussianity` over an episode, for prior and posterior: float64 `(2,)`, or None if s is discrete.

    Args:
        agent: agent in eval mode.
        episode: episode along which the agent filters.
        seed: random seed for the samples.
    """
    model = agent.model
    heads = model.prior, model.posterior
    if any(isinstance(head, CategoricalBelief) for head in heads):
        return None
    with filter_episode(agent, episode, 1, derive_seed(seed, "gaussianity", 0)) as (filtered, _):
        every = ceil_div(filtered.hidden.shape[1], _STEPS)
        contexts = model.prior_context(filtered.hidden[0, ::every]), filtered.context[0, ::every]  # 2 x (T / every, C)
        return torch.stack([non_gaussianity(*each).mean().cpu() for each in zip(heads, contexts, strict=True)])  # (2,)


def exact_variance(process: Process, episode: Episode, seed: int) -> Tensor:
    r"""Estimate the variance of each reward under the exact belief, by importance sampling.

    .. math:: s_{t-1}^k \sim p(\cdot \mid o_{1:t-1}, a_{1:t-2}), \quad
              s_t^k \sim p(\cdot \mid s_{t-1}^k, a_{t-1}), \quad w_t^k \propto p(o_t \mid s_t^k)

    Args:
        process: process in which the episode was played.
        episode: episode of T actions, each in [-1, 1] or one-hot.
        seed: random seed for the samples.

    Returns:
        Variances in squared units of reward, float64 `(T,)`.
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


def learned_variance(agent: WorldModelAgent, episode: Episode, seed: int) -> Tensor:
    """Return the variance of each reward over samples of the agent's belief, in squared units of reward, `(T,)`."""
    with filter_episode(agent, episode, DRAWS, seed) as (filtered, _):
        reward: Tensor = agent.reward(filtered.features)[:, 1:]  # (S, T)
        return reward.double().var(0).cpu()


def uncertainty(learned: Sequence[Tensor], exact: Sequence[Tensor]) -> Estimate | None:
    """Return u over E episodes, at least 2, with the standard error of a ratio; None if no reward is uncertain."""
    of_agent, of_exact = (torch.stack([variance.sum() for variance in variances]) for variances in (learned, exact))
    certain = of_exact.sum() < _ROUNDING
    return None if certain else Estimate.per_step(of_agent, of_exact)  # 2 x (E,)
