"""An agent in an episode: it filters what it is shown, and acts on its belief."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forbes.beliefs.categorical import one_hot_of
from forbes.control.planning import CrossEntropy, plan
from forbes.control.policy import Actor, Policy
from forbes.models import Filtered, State, StateSpaceModel
from forbes.seeding import derive_seed

__all__ = ["ActionSelector", "Agent", "explore", "follow_plan", "greedy", "noisy"]

ActionSelector: TypeAlias = Callable[[Filtered], Tensor]
"""What to do at the last step of K filtered trajectories, `(K, 1, …)`: an action, `(1, A)`, in [-1, 1] or one-hot."""


class Agent:
    r"""Plays one episode: shown o_t, it moves its belief on and gives a_t.

    .. math:: f_t^k = [h_t^k, s_t^k] \sim q(\cdot \mid o_{1:t}, a_{1:t-1}), \qquad
              a_t = \mathrm{choice}(f_t^1, \dots, f_t^K)

    With K = 1, as in the paper, it acts on one guess of its state; more of them tell how certain it can be.

    Args:
        model: in eval mode.
        select_action: see `ActionSelector`; e.g. `greedy(actor)`.
        seed: of everything that is drawn; step t depends on (seed, t) and on what was shown.
        samples: K, trajectories of the posterior.
    """

    def __init__(self, model: StateSpaceModel, select_action: ActionSelector, seed: int, samples: int = 1) -> None:
        self.model, self.select_action, self.seed, self.samples = model, select_action, seed, samples
        self.belief, self.steps = model.initial(samples), 0
        self.action = self.belief.state.new_zeros(1, model.action_dim)

    @torch.no_grad()
    def __call__(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Act on o_t, in the form it is stored in: `(*O)` to `(A,)`."""
        device = self.action.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(derive_seed(self.seed, "act", self.steps))
            shown = torch.from_numpy(observation).to(device)[None, None]  # (1, 1, *O)
            embedding = self.model.embed(shown).expand(self.samples, -1, -1)  # (K, 1, E)
            taken = self.action[:, None].expand(self.samples, -1, -1)  # (K, 1, A)
            filtered = self.model.filter(embedding, taken, self.belief)
            self.action = self.select_action(filtered)
        self.belief, self.steps = filtered.at(0), self.steps + 1
        action: NDArray[np.float32] = self.action[0].float().cpu().numpy()
        return action


def greedy(actor: Actor) -> ActionSelector:
    r"""Take the most probable action, as for an evaluation; of K trajectories, what they agree on.

    .. math:: a = \tfrac1K \sum_k \mathrm{mode}\,\pi(\cdot \mid f^k), \qquad
              \text{of discrete actions the one that most trajectories choose}
    """

    def select_action(filtered: Filtered) -> Tensor:
        policy: Policy = actor(filtered.features[:, 0])
        return _agreed(policy.mode(), actor.discrete)

    return select_action


def explore(actor: Actor, amount: float) -> ActionSelector:
    """Sample from the policy and add exploration noise, as Dreamer does to collect data; average over K trajectories.

    Args:
        actor: the policy.
        amount: standard deviation of the noise; of discrete actions the probability of a uniformly random one.
    """

    def select_action(filtered: Filtered) -> Tensor:
        policy: Policy = actor(filtered.features[:, 0])
        return _agreed(policy.rsample()[0], actor.discrete)

    return _epsilon_greedy(select_action, amount) if actor.discrete else noisy(select_action, amount)


def _agreed(action: Tensor, discrete: bool) -> Tensor:
    """Return the mean of K actions, or the commonest, `(K, A)` to `(1, A)`."""
    mean = action.mean(0, keepdim=True)  # (1, A)
    return one_hot_of(mean.argmax(-1, keepdim=True), mean) if discrete else mean


def noisy(select_action: ActionSelector, noise: float) -> ActionSelector:
    """Add N(0, noise²) to a choice, and clip to [-1, 1]."""

    def choose_nearby(filtered: Filtered) -> Tensor:
        action = select_action(filtered)
        return (action + noise * torch.randn_like(action)).clamp(-1, 1)

    return choose_nearby


def _epsilon_greedy(select_action: ActionSelector, chance: float) -> ActionSelector:
    """Replace a discrete choice by one of all alike, with a probability (ε-greedy)."""

    def choose_or_draw(filtered: Filtered) -> Tensor:
        action = select_action(filtered)  # (1, A)
        drawn = one_hot_of(torch.randint(action.shape[-1], (1, 1), device=action.device), action)
        return torch.where(torch.rand(1, 1, device=action.device) < chance, drawn, action)

    return choose_or_draw


def follow_plan(model: StateSpaceModel, reward: Callable[[Tensor], Tensor], search: CrossEntropy) -> ActionSelector:
    """Search again at each step, every candidate on a sample of the belief of its own (PlaNet).

    Of K trajectories, the candidates take turns.
    """

    def select_action(filtered: Filtered) -> Tensor:
        turns = -(-search.candidates // len(filtered.hidden))  # J / K, rounded up
        state, _ = model.posterior.rsample(filtered.context[:, 0], (turns,))  # (J / K, K, D)
        hidden = filtered.hidden[:, 0].expand(turns, -1, -1)  # (J / K, K, H)
        start = State(*(values.flatten(0, 1)[: search.candidates] for values in (hidden, state)))  # (J, H), (J, D)
        return plan(model, reward, start, model.action_dim, search)

    return select_action
