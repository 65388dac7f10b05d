r"""A linear-Gaussian process, whose evidence is known exactly, as a state-space model.

.. math:: s_t = A s_{t-1} + b + Q^{1/2} w_t, \quad o_t = C s_t + r v_t, \quad s_0 = 0

The model's own networks compute it: two ReLUs make a line, the GRU forgets its state and is linear near zero.
"""

from functools import partial

import torch
from torch.distributions import MultivariateNormal
from torch.nn.functional import linear

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.models import ModelParts, Normal, StateSpaceModel
from forbes.models.networks import Decoder, Encoder

SCALE = 1e-3  # of h
NOISE, SPREAD = 0.8, 0.7  # r; Q = SPREAD² I
TRANSITION = torch.tensor([[0.9, 0.3], [-0.4, 0.8]])
EMISSION = torch.tensor([[1.0, 1.0], [1.0, -2.0], [1.0, 1.0]])  # orthogonal columns: diagonal posteriors


class Pixels(Encoder):
    embedding_dim = 3

    def forward(self, observation):
        return observation.flatten(1)


class Emission(Decoder):
    def forward(self, features):
        return linear(features[:, -2:], EMISSION).view(-1, 1, 1, 3)


def set_head(head, matrix, std):
    """Make a head's base N(matrix (c⁺ - c⁻), std²) for the context (c⁺, c⁻)."""
    base = getattr(head, "base", head)
    with torch.no_grad():
        base.parameters_of.weight.zero_()
        base.parameters_of.weight[:2] = torch.cat((matrix, -matrix), 1)
        base.parameters_of.bias[:2] = 0
        base.parameters_of.bias[2:] = (std - base.min_std).expm1().log()


def linear_gaussian_model(belief, build=StateSpaceModel):
    """The process with q(s_t | s_{t-1}, o_t) = p(s_t | s_{t-1}, o_t), exact but for what later observations say."""
    torch.manual_seed(0)
    sizes = {"action_dim": 0, "state_dim": 2, "hidden_dim": 4, "mlp_dim": 4, "mlp_layers": 1}
    model = build(ModelParts(belief, Pixels(), Emission(), Normal(NOISE, scale=1.0), **sizes))
    eye = torch.eye(2)
    both = torch.cat((torch.cat((eye, -eye), 1), torch.cat((-eye, eye), 1)))  # (x⁺, x⁻) to (x, -x)
    precision = 1 / SPREAD**2 + EMISSION.square().sum(0) / NOISE**2  # of the posterior, diagonal
    gain = torch.cat((TRANSITION / SPREAD**2 @ both[:2], EMISSION.T / NOISE**2), 1) / precision[:, None]  # (2, 4 + 3)
    gain[:, :4] /= SCALE
    with torch.no_grad():
        for network in (model.transition, model.gru, model.prior_context, model.posterior_context):
            for parameter in network.parameters():
                parameter.zero_()
        model.transition[0][0].weight.copy_(torch.cat((eye, -eye)))
        model.gru.weight_ih[8:] = SCALE * torch.eye(4)  # the new state, tanh(x) = x to 1e-6
        model.gru.bias_ih[4:8] = -100.0  # the update gate: nothing of the old state
        model.prior_context[0][0].weight.copy_(torch.eye(4) / SCALE)
        model.posterior_context[0][0].weight.copy_(torch.cat((gain, -gain)))
    set_head(model.prior, TRANSITION, SPREAD * torch.ones(2))
    set_head(model.posterior, torch.eye(2), precision.rsqrt())
    return model


def log_evidence(observation, transition, offset, covariance):
    """log p(o_{1:T}) from the joint covariance of all states: s = G (b + w) with G the sums of powers of A."""
    steps = len(observation)
    powers = [torch.linalg.matrix_power(transition, k) for k in range(steps)]
    zero = torch.zeros(2, 2, dtype=torch.float64)
    paths = torch.cat([torch.cat([powers[t - u] if u <= t else zero for u in range(steps)], 1) for t in range(steps)])
    emission = torch.block_diag(*[EMISSION.double()] * steps) @ paths  # (3 T, 2 T)
    joint = emission @ torch.block_diag(*[covariance] * steps) @ emission.T + NOISE**2 * torch.eye(3 * steps)
    return MultivariateNormal(emission @ offset.repeat(steps), joint).log_prob(observation.flatten())


def bounds(model, observation, samples):
    """J of one sequence with so many posterior trajectories, `(samples,)`."""
    stored = (observation.float() + 0.5).expand(samples, *observation.shape).unflatten(-1, (1, 1, 3))  # (N, T, 1, 1, 3)
    action, mask = torch.zeros(*stored.shape[:2], 0), torch.ones(*stored.shape[:2], dtype=torch.bool)
    with torch.no_grad():
        return model.lower_bound(stored, action, mask).elbo.double()


def observations(steps, seed):
    """A sequence of the process's size, (T, 3); any would do."""
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.randn(steps, 3, generator=generator, dtype=torch.float64)


def drawn(steps, seed):
    """A sequence that the process itself has made, (T, 3)."""
    generator = torch.Generator().manual_seed(seed)
    state, made = torch.zeros(2, dtype=torch.float64), []
    for _ in range(steps):
        noise = torch.randn(5, generator=generator, dtype=torch.float64)
        state = TRANSITION.double() @ state + SPREAD * noise[:2]
        made.append(EMISSION.double() @ state + NOISE * noise[2:])
    return torch.stack(made)  # (T, 3)


def gaussian(build=StateSpaceModel):
    """A model with its A, b and Q."""
    model = linear_gaussian_model(partial(GaussianBelief, min_std=0.01), build)
    eye = torch.eye(2, dtype=torch.float64)
    return model, (TRANSITION.double(), 0 * eye[0], SPREAD**2 * eye)


def flow():
    """The prior is a flow of LU layers only, still linear-Gaussian; the posterior one with all its layers."""
    model = linear_gaussian_model(partial(FlowBelief, layers=2, width=8, min_std=0.01))
    mixing = model.prior.flow.mixings[0]
    with torch.no_grad():
        for parameter in (*mixing.parameters(), *model.posterior.flow.parameters()):
            parameter += 0.05 * torch.randn_like(parameter)
        matrix = mixing.matrix().double()
    return model, (matrix @ TRANSITION.double(), mixing.bias.detach().double(), SPREAD**2 * matrix @ matrix.T)
