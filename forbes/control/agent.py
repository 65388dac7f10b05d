"""An agent in an episode: it filters its observations, and acts on its belief."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forbes.beliefs.categorical import one_hot_of
from forbes.control.planning import CrossEntropy, plan
from forbes.control.policy import Actor, Policy
from forbes.factors import Discrete, factor_sizes
from forbes.models import Filtered, State, StateSpaceModel
from forbes.seeding import derive_seed
from forbes.shapes import Observed, map_parts

__all__ = ["ActionSelector", "Agent", "explore", "follow_plan", "greedy", "noisy"]

ActionSelector: TypeAlias = Callable[[Filtered], Tensor]
"""Select the action at the last step of K filtered trajectories: `(K, 1, …)` to `(1, A)`, in [-1, 1] or one-hot."""


class Agent:
    r"""Plays one episode: given o_t, it updates its belief and returns a_t.

    .. math:: f_t^k = [h_t^k, s_t^k] \sim q(\cdot \mid o_{1:t}, a_{1:t-1}), \qquad
              a_t = \mathrm{choice}(f_t^1, \dots, f_t^K)

    With K = 1, as in the paper, it acts on one sample of its state; more samples represent its uncertainty.

    Args:
        model: the world model, in eval mode.
        select_action: see `ActionSelector`; e.g. `greedy(actor)`.
        seed: random seed of all samples; step t depends on (seed, t) and on the observations.
        samples: trajectories of the posterior, K.
    """

    def __init__(self, model: StateSpaceModel, select_action: ActionSelector, seed: int, samples: int = 1) -> None:
        self.model, self.select_action, self.seed, self.samples = model, select_action, seed, samples
        self.belief, self.steps = model.initial(samples), 0
        self.action = self.belief.state.new_zeros(1, model.action_dim)

    @torch.no_grad()
    def __call__(self, observation: Observed) -> NDArray[np.float32]:
        """Act on o_t, in its stored form: `(*O)` to `(A,)`."""
        device = self.action.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(derive_seed(self.seed, "act", self.steps))
            shown = map_parts(lambda array: torch.from_numpy(array).to(device)[None, None], observation)  # (1, 1, *O)
            embedding = self.model.embed(shown).expand(self.samples, -1, -1)  # (K, 1, E)
            taken = self.action[:, None].expand(self.samples, -1, -1)  # (K, 1, A)
            filtered = self.model.filter(embedding, taken, self.belief)
            self.action = self.select_action(filtered)
        self.belief, self.steps = filtered.at(0), self.steps + 1
        action: NDArray[np.float32] = self.action[0].float().cpu().numpy()
        return action


def greedy(actor: Actor) -> ActionSelector:
    r"""Take the most probable action, as in an evaluation; with K trajectories, the mean or the majority.

    .. math:: a = \tfrac1K \sum_k \mathrm{mode}\,\pi(\cdot \mid f^k), \qquad
              \text{for discrete actions the one that most trajectories select}

    Actions with several factors are voted on factor by factor.
    """

    def select_action(filtered: Filtered) -> Tensor:
        policy: Policy = actor(filtered.features[:, 0])
        return _agreed(policy.mode(), actor.discrete)

    return select_action


def explore(actor: Actor, amount: float) -> ActionSelector:
    """Sample from the policy and add exploration noise, as Dreamer does to collect data; average over K trajectories.

    Args:
        actor: the policy.
        amount: standard deviation of the noise; for discrete actions the probability of a uniformly random one.
    """

    def select_action(filtered: Filtered) -> Tensor:
        policy: Policy = actor(filtered.features[:, 0])
        return _agreed(policy.rsample()[0], actor.discrete)

    return _epsilon_greedy(select_action, amount, actor.discrete) if actor.discrete else noisy(select_action, amount)


def _agreed(action: Tensor, discrete: Discrete) -> Tensor:
    """Return the mean of K actions, or the most frequent choice of each factor, `(K, A)` to `(1, A)`."""
    mean = action.mean(0, keepdim=True)  # (1, A)
    if not discrete:
        return mean
    votes = mean.split(factor_sizes(discrete, mean.shape[-1]), -1)  # F x (1, A_f)
    return torch.cat([one_hot_of(vote.argmax(-1, keepdim=True), vote) for vote in votes], -1)  # (1, A)


def noisy(select_action: ActionSelector, noise: float) -> ActionSelector:
    """Add N(0, noise²) to the selected action, and clip it to [-1, 1]."""

    def select_nearby(filtered: Filtered) -> Tensor:
        action = select_action(filtered)
        return (action + noise * torch.randn_like(action)).clamp(-1, 1)

    return select_nearby


def _epsilon_greedy(select_action: ActionSelector, chance: float, discrete: Discrete) -> ActionSelector:
    """Replace a discrete action by a uniformly random one, in all its factors, with probability `chance` (ε-greedy)."""

    def select_or_draw(filtered: Filtered) -> Tensor:
        action = select_action(filtered)  # (1, A)
        factors = action.split(factor_sizes(discrete, action.shape[-1]), -1)  # F x (1, A_f)
        drawn = [one_hot_of(torch.randint(x.shape[-1], (1, 1), device=x.device), x) for x in factors]
        return torch.where(torch.rand(1, 1, device=action.device) < chance, torch.cat(drawn, -1), action)

    return select_or_draw


def follow_plan(model: StateSpaceModel, reward: Callable[[Tensor], Tensor], search: CrossEntropy) -> ActionSelector:
    """Plan at each step, each candidate from its own sample of the belief (PlaNet).

    With K trajectories, the candidates take turns.
    """

    def select_action(filtered: Filtered) -> Tensor:
        turns = -(-search.candidates // len(filtered.hidden))  # J / K, rounded up
        state, _ = model.posterior.rsample(filtered.context[:, 0], (turns,))  # (J / K, K, D)
        hidden = filtered.hidden[:, 0].expand(turns, -1, -1)  # (J / K, K, H)
        start = State(*(values.flatten(0, 1)[: search.candidates] for values in (hidden, state)))  # (J, H), (J, D)
        return plan(model, reward, start, model.action_dim, search)

    return select_action
