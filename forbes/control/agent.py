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

__all__ = ["Agent", "Choice", "explore", "follow_plan", "noisy", "take_mode"]

Choice: TypeAlias = Callable[[Filtered], Tensor]
"""What to do at the last step of a filtered history, `(1, 1, …)`: an action, `(1, A)`, in [-1, 1] or one-hot."""


class Agent:
    r"""Plays one episode: shown o_t, it moves its belief on and gives a_t.

    .. math:: (h_t, s_t) \sim q(\cdot \mid o_{1:t}, a_{1:t-1}), \qquad a_t = \mathrm{choice}(h_t, s_t)

    Args:
        model: in eval mode.
        choose: see `Choice`; e.g. `take_mode(actor)`.
        seed: of everything that is drawn; step t depends on (seed, t) and on what was shown.
    """

    def __init__(self, model: StateSpaceModel, choose: Choice, seed: int) -> None:
        self.model, self.choose, self.seed = model, choose, seed
        self.belief, self.steps = model.initial(1), 0
        self.action = self.belief.state.new_zeros(1, model.action_dim)

    @torch.no_grad()
    def __call__(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Act on o_t, in the form it is stored in: `(*O)` to `(A,)`."""
        device = self.action.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(derive_seed(self.seed, "act", self.steps))
            shown = torch.from_numpy(observation).to(device)[None, None]  # (1, 1, *O)
            filtered = self.model.filter(self.model.embed(shown), self.action[:, None], self.belief)
            self.action = self.choose(filtered)
        self.belief, self.steps = filtered.at(0), self.steps + 1
        action: NDArray[np.float32] = self.action[0].float().cpu().numpy()
        return action


def take_mode(actor: Actor) -> Choice:
    """Take the most probable action, as for an evaluation."""

    def choose(filtered: Filtered) -> Tensor:
        policy: Policy = actor(filtered.features[:, 0])
        return policy.mode()

    return choose


def explore(actor: Actor, amount: float) -> Choice:
    """Draw from the policy, and stray from it: how Dreamer collects.

    Args:
        actor: chooses.
        amount: standard deviation of the noise, or, where actions are discrete, how often one is replaced by any.
    """

    def choose(filtered: Filtered) -> Tensor:
        policy: Policy = actor(filtered.features[:, 0])
        return policy.rsample()[0]

    return _sometimes_any(choose, amount) if actor.discrete else noisy(choose, amount)


def noisy(choose: Choice, noise: float) -> Choice:
    """Add N(0, noise²) to a choice, and clip to [-1, 1]."""

    def choose_nearby(filtered: Filtered) -> Tensor:
        action = choose(filtered)
        return (action + noise * torch.randn_like(action)).clamp(-1, 1)

    return choose_nearby


def _sometimes_any(choose: Choice, chance: float) -> Choice:
    """Replace a discrete choice by one of all alike, with a probability (ε-greedy)."""

    def choose_or_draw(filtered: Filtered) -> Tensor:
        action = choose(filtered)  # (1, A)
        drawn = one_hot_of(torch.randint(action.shape[-1], (1, 1), device=action.device), action)
        return torch.where(torch.rand(1, 1, device=action.device) < chance, drawn, action)

    return choose_or_draw


def follow_plan(model: StateSpaceModel, reward: Callable[[Tensor], Tensor], search: CrossEntropy) -> Choice:
    """Search anew at each step, every candidate on a sample of the belief of its own (PlaNet)."""

    def choose(filtered: Filtered) -> Tensor:
        state, _ = model.posterior.rsample(filtered.context[:, 0], (search.candidates,))  # (J, 1, D)
        hidden = filtered.hidden[:, 0].expand(search.candidates, -1, -1)  # (J, 1, H)
        start = State(hidden.flatten(0, 1), state.flatten(0, 1))  # (J, H), (J, D)
        return plan(model, reward, start, model.action_dim, search)

    return choose
