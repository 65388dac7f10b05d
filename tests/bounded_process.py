"""A process whose exact belief has bounded support: what lies outside is impossible, and a reverse KL infinite."""

import math

import torch

from forbes.pomdps import ExactBelief, ExactFilter, Process
from forbes.pomdps.distributions import DiagonalGaussian

__all__ = ["Box"]


class Uniform(ExactBelief):
    """Uniform on [-1, 1], one for each of `zero`, `(*, 1)`."""

    def __init__(self, zero):
        self.mean_of = zero

    def log_prob(self, value):
        inside = ((value - self.mean_of).abs() <= 1).squeeze(-1)
        return torch.where(inside, -math.log(2), -torch.inf).double()

    def sample(self, count, generator):
        shape = (count, *self.mean_of.shape)
        return self.mean_of + 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1

    @property
    def mean(self):
        return self.mean_of

    @property
    def variance(self):
        return torch.full_like(self.mean_of, 1 / 3)

    @property
    def entropy(self):
        return torch.full_like(self.mean_of[..., 0], math.log(2))


class Box(Process):
    """Each state is uniform on [-1, 1], whatever came before, and observations are noise."""

    state_dim, observation_dim, action_dim = 1, 1, 0

    def initial(self, like):
        return Uniform(like.new_zeros(1))

    def transition(self, state, action):
        return Uniform(torch.zeros_like(state))

    def emission(self, state):
        return DiagonalGaussian(torch.zeros_like(state), 1.0)

    def policy(self, sequences, steps, generator):
        return torch.zeros(sequences, steps, 0, dtype=torch.float64)

    def exact_filter(self, observation, action):
        observation, _ = self.checked(observation, action)
        evidence = self.emission(torch.zeros_like(observation)).log_prob(observation)  # (B, T)
        return ExactFilter(Uniform(torch.zeros_like(observation)), evidence)
