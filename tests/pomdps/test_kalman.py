"""Kalman and backward information filter against the dense joint Gaussian of states and observations."""

import pytest
import torch

from forbes.pomdps.kalman import LinearSystem, kalman_filter, smoothing_conditional

D, E, T, B = 2, 3, 5, 4


def random(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_system(starts, seed=0):
    """Full matrices, so that a transposed one is seen."""
    noise, emission_noise, start = (random(n, n, seed=seed + i) for i, n in enumerate((D, E, D)))
    return LinearSystem(
        transition=random(D, D, seed=seed + 3),
        transition_covariance=noise @ noise.T + torch.eye(D),
        emission=random(E, D, seed=seed + 4),
        emission_covariance=emission_noise @ emission_noise.T + torch.eye(E),
        initial_mean=random(starts, D, seed=seed + 5),
        initial_covariance=start @ start.T + torch.eye(D),
    )


def states(*times):
    """Where s_t lies in the dense joint."""
    return [D * time + dim for time in times for dim in range(D)]


def observations(*times):
    """Where o_t lies in the dense joint."""
    return [D * T + E * time + dim for time in times for dim in range(E)]


@pytest.fixture(name="sequences")
def sequences_fixture():
    return random(B, T, E, seed=10), random(B, T, D, seed=11)  # o, u


def test_the_filter_is_the_dense_conditional(sequences, dense_joint, condition):
    observation, drive = sequences
    system = random_system(starts=1)

    belief, evidence = kalman_filter(system, observation, drive)

    for row in range(B):
        joint = dense_joint(system, drive[row])
        for time in range(T):
            seen = observations(*range(time + 1))
            gain, offset, covariance, density = condition(*joint, states(time), seen)
            past = observation[row, : time + 1].flatten()
            torch.testing.assert_close(belief.mean[row, time], gain @ past + offset)
            torch.testing.assert_close(belief.covariance[time], covariance)
            assert evidence[row, : time + 1].sum().item() == pytest.approx(density.log_prob(past).item(), abs=1e-10)


def test_several_starts_are_a_mixture_weighted_by_evidence(sequences, dense_joint, condition):
    observation, drive = sequences
    system, starts = random_system(starts=3), 3
    state = random(B, T, D, seed=12)

    belief, evidence = kalman_filter(system, observation, drive)

    for row in range(B):
        for time in range(T):
            past = observation[row, : time + 1].flatten()
            weights, densities = [], []
            for start in range(starts):
                joint = dense_joint(system, drive[row], start)
                seen = observations(*range(time + 1))
                gain, offset, covariance, density = condition(*joint, states(time), seen)
                weights.append(density.log_prob(past).exp() / starts)
                of_state = torch.distributions.MultivariateNormal(gain @ past + offset, covariance)
                densities.append(of_state.log_prob(state[row, time]).exp())
            weight, density = torch.stack(weights), torch.stack(densities)
            torch.testing.assert_close(evidence[row, : time + 1].sum(), weight.sum().log())
            torch.testing.assert_close(belief.log_weight[row, time].exp(), weight / weight.sum())
            expected = (weight * density).sum() / weight.sum()
            torch.testing.assert_close(belief.log_prob(state)[row, time], expected.log())


def test_the_smoothing_conditional_is_the_dense_one(sequences, dense_joint, condition):
    observation, drive = sequences
    system = random_system(starts=1)

    exact = smoothing_conditional(system, observation, drive)

    for row in range(B):
        joint = dense_joint(system, drive[row])
        for time in range(T):
            before = states(time - 1) if time > 0 else []
            gain, offset, covariance, _ = condition(*joint, states(time), before + observations(*range(time, T)))
            ahead = observation[row, time:].flatten()
            torch.testing.assert_close(exact.gain[time], gain[:, :D] if time > 0 else torch.zeros_like(covariance))
            torch.testing.assert_close(exact.offset[row, time], offset + gain[:, len(before) :] @ ahead)
            torch.testing.assert_close(exact.covariance[time], covariance)


def test_the_smoothing_conditional_gives_paths_equal_weight(sequences):
    """p(s, o) / q(s) = p(o) for whatever s, where q is the posterior: the variance of the weight is zero."""
    observation, drive = sequences
    system = random_system(starts=1)
    exact = smoothing_conditional(system, observation, drive)
    generator, paths = torch.Generator().manual_seed(0), 50
    normal = torch.distributions.MultivariateNormal

    state = torch.zeros(paths, B, D, dtype=torch.float64)
    log_weight = torch.zeros(paths, B, dtype=torch.float64)
    for time in range(T):
        conditional = exact.at(time, state)
        following = conditional.sample(1, generator)[0]  # (paths, B, D)
        moved = state @ system.transition.T + drive[:, time] if time > 0 else system.initial_mean
        noise = system.transition_covariance if time > 0 else system.initial_covariance
        log_weight += normal(moved, noise).log_prob(following) - conditional.log_prob(following)
        seen = normal(following @ system.emission.T, system.emission_covariance)
        log_weight += seen.log_prob(observation[:, time])
        state = following

    evidence = kalman_filter(system, observation, drive).log_likelihood
    torch.testing.assert_close(log_weight, evidence.expand(paths, -1), rtol=0, atol=1e-10)
