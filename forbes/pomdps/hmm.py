"""Processes with finitely many states, observations and actions: the forward algorithm (Rabiner, 1989)."""

import torch
from torch import Tensor

from forbes.errors import ForbesError
from forbes.pomdps.base import ExactFilter, Process
from forbes.pomdps.beliefs import FiniteBelief

__all__ = ["FiniteProcess"]


class FiniteProcess(Process):
    r"""A hidden Markov model with actions, defined by tables. States, observations and actions are one-hot.

    .. math:: \pi_t(s') = \sum_s T_a(s, s')\, b_{t-1}(s), \qquad p(o \mid o_{<t}) = \sum_{s'} O(s', o)\, \pi_t(s'),
              \qquad b_t(s') = \frac{O(s', o)\, \pi_t(s')}{p(o \mid o_{<t})}

    Args:
        initial: initial probability of each state, `(S,)` in float64.
        transition: transition probabilities :math:`T_a(s, s')`, `(A, S, S)`.
        emission: emission probabilities :math:`O(s, o)`, `(S, O)`.
        policy: probability of each action in `sample`, independent over time, `(A,)`.
    """

    def __init__(self, initial: Tensor, transition: Tensor, emission: Tensor, policy: Tensor) -> None:
        self.initial_table, self.transition_table, self.emission_table = initial, transition, emission
        self.policy_table = policy
        self.action_dim, self.state_dim = transition.shape[:2]
        self.observation_dim = emission.shape[-1]

    def initial(self, like: Tensor) -> FiniteBelief:
        """See `Process.initial`."""
        return FiniteBelief(self.initial_table.log().to(like))

    def transition(self, state: Tensor, action: Tensor) -> FiniteBelief:
        """See `Process.transition`."""
        table = self.transition_table.log().to(state)
        return FiniteBelief(table[action.argmax(-1), state.argmax(-1)])  # (*, S)

    def emission(self, state: Tensor) -> FiniteBelief:
        """See `Process.emission`."""
        return FiniteBelief(self.emission_table.log().to(state)[state.argmax(-1)])  # (*, O)

    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """See `Process.policy`."""
        action = FiniteBelief(self.policy_table.log())
        return action.sample(sequences * steps, generator).view(sequences, steps, -1)  # (B, steps, A)

    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """See `Process.exact_filter`; observations of probability 0 are an error."""
        observation, action = self.checked(observation, action)
        self._require_one_hot("observation", observation, first=0)
        self._require_one_hot("action", action, first=1)
        action_index = action.argmax(-1)  # (B, T)
        likelihood = (observation @ self.emission_table.T).unbind(1)  # T x (B, S)
        predicted = self.initial_table.expand(len(observation), -1)  # (B, S)
        masses: list[Tensor] = []
        evidences: list[Tensor] = []
        for time, seen in enumerate(likelihood):
            if time > 0:
                transition = self.transition_table[action_index[:, time]]  # (B, S, S)
                predicted = (masses[-1].unsqueeze(1) @ transition).squeeze(1)  # (B, S)
            joint = predicted * seen
            evidences.append(joint.sum(-1))  # (B,)
            masses.append(joint / evidences[-1].unsqueeze(-1))
        evidence = torch.stack(evidences, 1)  # (B, T)
        if len(impossible := torch.nonzero(~(evidence > 0))):
            sequence, step = impossible[0].tolist()
            raise ForbesError(
                f"{type(self).__name__}: sequence {sequence} has probability 0 from step {step} on, expected a "
                "possible sequence. Compare the parameters with those that generated the data"
            )
        return ExactFilter(FiniteBelief(torch.stack(masses, 1).log()), evidence.log())  # (B, T, S), (B, T)

    def _require_one_hot(self, name: str, values: Tensor, first: int) -> None:
        right = ((values == 0) | (values == 1)).all(-1) & (values.sum(-1) == 1)  # (B, T)
        if len(wrong := torch.nonzero(~right[:, first:])):
            sequence, step = wrong[0].tolist()
            raise ForbesError(
                f"{type(self).__name__}: the {name} of sequence {sequence} at step {step + first} is not one-hot, "
                f"expected one 1 among {values.shape[-1]} values and 0 elsewhere. Encode it as one-hot"
            )
