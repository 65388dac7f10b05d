r"""The interface of all processes: sampling, densities, and the exact belief.

.. math:: s_1 \sim p(s), \qquad s_t \sim p(s \mid s_{t-1}, a_{t-1}), \qquad o_t \sim p(o \mid s_t)
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.errors import ForbesError, require_positive
from forbes.named import Named
from forbes.pomdps.beliefs import ExactBelief, GaussianMixtureBelief
from forbes.pomdps.distributions import Distribution
from forbes.shapes import printed_by_shape

__all__ = ["AffineGaussian", "ExactFilter", "Process", "Trajectories"]


@printed_by_shape
class Trajectories(NamedTuple):
    """Sequences of a process in float64. Index t has (s_t, o_t, a_{t-1}): the action that led to s_t, 0 at the start.

    An example of three steps, where a1 leads from s1 to s2::

        state        s1  s2  s3
        observation  o1  o2  o3
        action       0   a1  a2
    """

    state: Tensor
    """s_t, `(B, T, D)`."""
    observation: Tensor
    """o_t, `(B, T, O)`."""
    action: Tensor
    """a_{t-1}, `(B, T, A)`; A may be 0."""


@printed_by_shape
class ExactFilter(NamedTuple):
    """Result of exact filtering."""

    belief: ExactBelief
    """p(s_t | o_1:t, a_1:t-1) for each sequence and step, `(B, T)`."""
    step_log_likelihood: Tensor
    """log p(o_t | o_1:t-1, a_1:t-1) in nats, `(B, T)`: the highest prequential score in expectation."""

    @property
    def log_likelihood(self) -> Tensor:
        """Total log-likelihood log p(o_1:T | a_1:T-1) in nats, `(B,)`."""
        return self.step_log_likelihood.sum(1)


@printed_by_shape
class AffineGaussian(NamedTuple):
    r"""A Gaussian with a mean affine in the previous state: :math:`p(s_t \mid s_{t-1}) = N(G_t s_{t-1} + g_t, C_t)`."""

    gain: Tensor
    """G_t, `(T, D, D)`; zero at the start, where there is no previous state."""
    offset: Tensor
    """g_t, `(B, T, D)`."""
    covariance: Tensor
    """C_t, `(T, D, D)`."""

    def at(self, time: int, previous: Tensor) -> GaussianMixtureBelief:
        """Return the Gaussian of s_t at index `time` (from 0), given s_{t-1} of shape `(..., B, D)`."""
        mean = previous @ self.gain[time].T + self.offset[:, time]  # (..., B, D)
        return GaussianMixtureBelief(mean.new_zeros(*mean.shape[:-1], 1), mean.unsqueeze(-2), self.covariance[time])


class Process(Named, ABC):
    """A partially observable process with an exactly known belief.

    To add one, copy the file that is most similar: `linear_gaussian.py` (Kalman), `mirror_sensor.py` (grid) or
    `tiger.py` (finite). A process defines three dimensions, its initial distribution, transition, emission and policy.
    Sampling and densities follow from these. Finite states, observations and actions are one-hot vectors.

    Actions never depend on the state, so they carry no information about it.
    """

    state_dim: int
    """Dimension of the state, D."""
    observation_dim: int
    """Dimension of an observation, O."""
    action_dim: int
    """Dimension of an action, A; 0 for a process without actions."""
    action_scale: float = 1.0
    """Factor that is applied to an agent's action in [-1, 1]^A."""

    @abstractmethod
    def initial(self, like: Tensor) -> Distribution:
        """Return p(s_1), in the dtype and on the device of `like`."""

    @abstractmethod
    def transition(self, state: Tensor, action: Tensor) -> Distribution:
        """Return p(s_t | s_{t-1}, a_{t-1}) for `(*, D)` and `(*, A)`, which broadcast."""

    @abstractmethod
    def emission(self, state: Tensor) -> Distribution:
        """Return p(o_t | s_t) for `(*, D)`."""

    @abstractmethod
    def policy(self, sequences: int, steps: int, generator: torch.Generator) -> Tensor:
        """Sample actions a_1, a_2, … for `sample`, independent of states and observations: float64 `(B, steps, A)`."""

    @abstractmethod
    def exact_filter(self, observation: Tensor, action: Tensor) -> ExactFilter:
        """Compute the belief and the evidence of every step, in float64 on the CPU.

        Args:
            observation: o_t, `(B, T, O)`.
            action: a_{t-1}, zero at the first step, `(B, T, A)`.

        Raises:
            ForbesError: if a shape or a value is not one that the process can produce (`checked`).
        """

    def exact_smoothing_conditional(self, observation: Tensor, action: Tensor) -> AffineGaussian | None:
        r"""Return :math:`p(s_t \mid s_{t-1}, a, o_{t:T})`, in float64 on the CPU, or None if it is not Gaussian.

        The product over t is the posterior of the whole path, the optimal proposal, all of whose weights are p(o).
        """
        return None

    def reward(self, state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        """Return r(s_{t-1}, a_{t-1}, s_t) for `(*, D)`, `(*, A)` and `(*, D)`, `(*)`. The filter does not use it.

        Raises:
            ForbesError: if the process has no rewards.
        """
        where = type(self).__name__
        raise ForbesError(f"{where}: has no rewards, expected a process with rewards. Choose another, or add them")

    def terminal(self, state: Tensor) -> Tensor:
        """Return whether an agent's episode ends in a state: `(*, D)` to bool `(*)`. `sample` ignores this."""
        return torch.zeros(state.shape[:-1], dtype=torch.bool, device=state.device)

    def log_likelihood(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return log p(o_1:T | a_1:T-1) in nats, `(B,)`."""
        return self.exact_filter(observation, action).log_likelihood

    def log_initial(self, state: Tensor) -> Tensor:
        """Return log p(s_1) in nats: `(*, D)` to `(*)`."""
        return self.initial(state).log_prob(state)

    def log_transition(self, next_state: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """Return log p(s_t | s_{t-1}, a_{t-1}) in nats: `(*, D)`, `(*, D)` and `(*, A)`, which broadcast, to `(*)`."""
        return self.transition(state, action).log_prob(next_state)

    def log_observation(self, observation: Tensor, state: Tensor) -> Tensor:
        """Return log p(o_t | s_t) in nats: `(*, O)` and `(*, D)`, which broadcast, to `(*)`."""
        return self.emission(state).log_prob(observation)

    def sample(self, sequences: int, length: int, generator: torch.Generator) -> Trajectories:
        """Sample B sequences of T steps under `policy`, as a pure function of the generator's state.

        Raises:
            ForbesError: if `sequences` or `length` is below 1.
        """
        require_positive(type(self).__name__, sequences=sequences, length=length)
        start = torch.zeros(sequences, 1, self.action_dim, dtype=torch.float64)
        policy = self.policy(sequences, length, generator)  # a_1, ..., a_T, of which a_T is not used, (B, T, A)
        action = torch.cat((start, policy[:, :-1]), 1)  # (B, T, A)
        state = self.initial(start).sample(sequences, generator)  # (B, D)
        states = [state]
        for previous_action in action.unbind(1)[1:]:
            state = self.transition(state, previous_action).sample(1, generator).squeeze(0)  # (B, D)
            states.append(state)
        path = torch.stack(states, 1)  # (B, T, D)
        return Trajectories(path, self.emission(path).sample(1, generator).squeeze(0), action)

    def checked(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return both in float64 on the CPU; raise a ForbesError if a shape or value is invalid."""
        where = type(self).__name__
        _require_sequences(f"{where}: the observation", observation, self.observation_dim)
        _require_sequences(f"{where}: the action", action, self.action_dim)
        if observation.shape[:2] != action.shape[:2]:
            shapes = f"{tuple(observation.shape[:2])} and {tuple(action.shape[:2])}"
            raise ForbesError(
                f"{where}: (B, T) of observation and action are {shapes}, expected the same. Cut both to one length"
            )
        if action[:, 0].any():
            raise ForbesError(
                f"{where}: the first action is not zero, expected index t to have the action that led to o_t. Shift "
                "the actions by one step"
            )
        return observation.double().cpu(), action.double().cpu()


def _require_sequences(where: str, values: Tensor, dim: int) -> None:
    if values.dim() != 3 or values.shape[-1] != dim or values.shape[1] < 1:
        shape = tuple(values.shape)
        raise ForbesError(f"{where} has shape {shape}, expected (B, T, {dim}), T at least 1. Reshape it")
    if len(bad := torch.nonzero(~values.isfinite())):
        sequence, step, _ = bad[0].tolist()
        value = values[tuple(bad[0])].item()
        raise ForbesError(
            f"{where} of sequence {sequence} at step {step} is {value}, expected finite numbers. Leave the sequence out"
        )
