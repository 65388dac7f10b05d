r"""A known process with a learned belief: the densities are the true ones, and only q is trained.

.. math:: g_t = \mathrm{GRU}(g_{t-1}, [o_t, a_{t-1}]), \qquad q(s_{1:T} \mid o, a) = \prod_t q(s_t \mid g_t)

Only observations and actions feed the recurrence. So q(s_t | g_t) is the belief itself, has a density, and can be
compared with the exact p(s_t | o_1:t). The state of a learned state-space model has no such counterpart.
"""

from typing import Protocol

import torch
from torch import Tensor, nn

from forbes.beliefs import BeliefFamily, BeliefHead
from forbes.models.elbo import ElboTerms
from forbes.models.networks import MLP

__all__ = ["Densities", "KnownModel", "LearnedBelief", "Standardizer"]


class Densities(Protocol):
    """The densities of a process that the bound needs, in nats, differentiable in the state."""

    def log_initial(self, state: Tensor) -> Tensor:
        """Return log p(s_1): `(*, D)` to `(*)`."""

    def log_transition(self, next_state: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """Return log p(s_t | s_{t-1}, a_{t-1}): `(*, D)`, `(*, D)` and `(*, A)`, which broadcast, to `(*)`."""

    def log_observation(self, observation: Tensor, state: Tensor) -> Tensor:
        """Return log p(o_t | s_t): `(*, O)` and `(*, D)`, which broadcast, to `(*)`."""


class Standardizer(nn.Module):
    r"""Standardise a vector to mean 0 and variance 1, :math:`z = (x - \mu) / \sigma`, with constants from examples.

    Networks and the smallest standard deviations of belief families assume a scale of about 1; some processes have 10.

    Args:
        examples: `(N, D)`, N at least 2, none of the D constant.
    """

    def __init__(self, examples: Tensor) -> None:
        super().__init__()
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", examples.mean(0).float())
        self.register_buffer("std", examples.std(0).float())

    def forward(self, x: Tensor) -> Tensor:
        """Return z of x, `(*, D)`."""
        return (x - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        """Return x of z, `(*, D)`."""
        return torch.addcmul(self.mean, z, self.std)

    def log_det(self) -> Tensor:
        """Return log|det ∂x/∂z| in nats, a scalar."""
        return self.std.log().sum()


class LearnedBelief:
    r"""The belief q(s_t | g_t) at every step of every sequence, in units of the process, :math:`s = \mu + \sigma z`.

    .. math:: \log q(s_t \mid g_t) = \log q_z(z_t \mid c_t) - \textstyle\sum_d \log \sigma_d

    Args:
        head: :math:`q_z`, the head of a belief family.
        context: :math:`c_t`, a function of g_t, `(B, T, C)`.
        units: has :math:`\mu` and :math:`\sigma`.
    """

    def __init__(self, head: BeliefHead, context: Tensor, units: Standardizer) -> None:
        self.head, self.context, self.units = head, context, units

    def rsample(self, count: int) -> tuple[Tensor, Tensor]:
        """Sample s_t, reparameterised, with log q(s_t) in nats: `(count, B, T, D)` and `(count, B, T)`."""
        z, log_prob = self.head.rsample(self.context, (count,))
        return self.units.inverse(z), log_prob - self.units.log_det()

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Sample s_t, `(count, B, T, D)`, as a pure function of the generator's state."""
        seed = torch.randint(2**62, (), generator=generator)
        with torch.random.fork_rng([]), torch.no_grad():
            torch.manual_seed(int(seed))
            return self.rsample(count)[0]

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log q(s_t) in nats: `(..., B, T, D)` to `(..., B, T)`."""
        return self.head.log_prob(self.units(value), self.context) - self.units.log_det()


class KnownModel(nn.Module):
    """The belief of a known process: a GRU over observations and actions, and the head of a belief family.

    Args:
        process: the true densities.
        belief: builds the head from (state_dim, context_dim).
        of_state: standardises s_t.
        of_input: standardises [o_t, a_{t-1}].
        hidden_dim: dimensions of g, H.
        mlp_dim: width of the MLP between g and the head, and of the head's context, C.
        mlp_layers: layers of this MLP.
    """

    def __init__(
        self,
        process: Densities,
        belief: BeliefFamily,
        of_state: Standardizer,
        of_input: Standardizer,
        hidden_dim: int,
        mlp_dim: int,
        mlp_layers: int,
    ) -> None:
        super().__init__()
        self.process, self.of_state, self.of_input = process, of_state, of_input
        self.gru = nn.GRU(len(of_input.mean), hidden_dim, batch_first=True)
        self.context = MLP(hidden_dim, mlp_dim, mlp_layers)
        self.head: BeliefHead = belief(len(of_state.mean), mlp_dim)

    def belief(self, observation: Tensor, action: Tensor) -> LearnedBelief:
        """Return the belief after each step, given o_1, …, o_t, `(B, T, O)`, and a_1, …, a_{t-1}, `(B, T, A)`."""
        hidden, _ = self.gru(self.of_input(torch.cat((observation, action), -1)))  # (B, T, H)
        return LearnedBelief(self.head, self.context(hidden), self.of_state)

    def elbo(self, observation: Tensor, action: Tensor, mask: Tensor) -> ElboTerms:
        r"""Estimate the bound on log p(o_1:T | a_1:T-1) with one sample per sequence; arguments as in `SequenceBatch`.

        .. math:: J = E_q \sum_t \log p(o_t \mid s_t) - \left(\log q(s_t \mid g_t)
                  - \log p(s_t \mid s_{t-1}, a_{t-1})\right)
        """
        state, log_prob = (drawn.squeeze(0) for drawn in self.belief(observation, action).rsample(1))
        first = self.process.log_initial(state[:, :1])  # (B, 1)
        later = self.process.log_transition(state[:, 1:], state[:, :-1], action[:, 1:])  # (B, T - 1)
        return ElboTerms(
            reconstruction=self.process.log_observation(observation, state),
            kl=log_prob - torch.cat((first, later), 1),  # (B, T)
            analytic_kl=None,
            mask=mask,
        )
