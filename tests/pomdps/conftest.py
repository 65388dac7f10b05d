"""What the tests of processes share: a second opinion on the evidence, and Gaussians conditioned as one dense joint."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal


@pytest.fixture(scope="session")
def evidence_ratios():
    """Estimates of p(o) over the exact p(o) by independent bootstrap particle filters: their mean is 1."""

    def estimate(process, observation, action, filters, particles, seed=0):
        """One sequence `(1, T, ...)` to `(filters,)`. Gordon et al. (1993): the estimate of p(o) is unbiased."""
        generator = torch.Generator().manual_seed(seed)
        state = process.initial(observation).sample(filters * particles, generator)  # (R N, D)
        state = state.view(filters, particles, -1)  # (R, N, D)
        total = observation.new_zeros(filters)
        for time in range(observation.shape[1]):
            if time > 0:
                state = process.transition(state, action[:, time, None]).sample(1, generator)[0]
            log_weight = process.log_observation(observation[:, time, None], state)  # (R, N)
            total += log_weight.logsumexp(1) - math.log(particles)
            chosen = torch.multinomial(log_weight.softmax(1), particles, True, generator=generator)  # (R, N)
            state = state.gather(1, chosen[..., None].expand_as(state))  # (R, N, D)
        return (total - process.log_likelihood(observation, action)).exp()

    return estimate


@pytest.fixture(scope="session")
def dense_joint():
    """The mean and covariance of (s_1, ..., s_T, o_1, ..., o_T) as one Gaussian, built from the noises up."""

    def build(system, drive, start=0):
        """One drive `(T, D)` to `(T (D + O),)` and its square."""
        length, dim = drive.shape
        power = [torch.linalg.matrix_power(system.transition, n) for n in range(length)]
        zero = torch.zeros(dim, dim, dtype=drive.dtype)
        from_noise = torch.cat(  # s = from_noise (s_1, w_2, ..., w_T), (T D, T D)
            [torch.cat([power[t - i] if i <= t else zero for i in range(length)], 1) for t in range(length)]
        )
        noise = torch.block_diag(system.initial_covariance, *[system.transition_covariance] * (length - 1))
        mean = from_noise @ torch.cat((system.initial_mean[start], drive[1:].flatten()))  # (T D,)
        covariance = from_noise @ noise @ from_noise.T
        seen = torch.block_diag(*[system.emission] * length)  # (T O, T D)
        both = torch.cat((torch.eye(length * dim, dtype=drive.dtype), seen))
        joint = both @ covariance @ both.T
        joint[length * dim :, length * dim :] += torch.block_diag(*[system.emission_covariance] * length)
        return both @ mean, joint

    return build


@pytest.fixture(scope="session")
def condition():
    """Condition a dense Gaussian: gain, offset and covariance of x[of] given x[given], and the density of x[given]."""

    def regress(mean, covariance, of, given):
        gain = torch.linalg.solve(covariance[given][:, given], covariance[given][:, of]).T
        rest = covariance[of][:, of] - gain @ covariance[given][:, of]
        return gain, mean[of] - gain @ mean[given], rest, MultivariateNormal(mean[given], covariance[given][:, given])

    return regress
