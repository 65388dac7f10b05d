"""The mountain hike: what its steps are, and its belief from several starts as a sum over these."""

import math

import pytest
import torch

from forbes.errors import ForbesError
from forbes.pomdps import MountainHike
from forbes.pomdps.mountain_hike import STARTS, step_of


def draw(process, sequences, length, seed=0):
    return process.sample(sequences, length, torch.Generator().manual_seed(seed))


def test_a_step_keeps_its_direction_and_is_at_most_0_05_long():
    action = draw(MountainHike(), 200, 10).action[:, 1:]  # (200, 9, 2)

    step = step_of(action)

    length, wanted = step.norm(dim=-1), action.norm(dim=-1)
    torch.testing.assert_close(length, wanted.clamp(max=0.05))
    torch.testing.assert_close(step * wanted[..., None], action * length[..., None])
    # |a| is Rayleigh: longer than its scale with probability e^-½.
    share, expected = (wanted > 0.05).double().mean(), math.exp(-0.5)
    assert abs(share - expected) < 4 * math.sqrt(expected * (1 - expected) / wanted.numel())


def test_standing_still_has_a_gradient():
    action = torch.zeros(2, dtype=torch.float64, requires_grad=True)

    (slope,) = torch.autograd.grad(step_of(action).sum(), action)

    torch.testing.assert_close(slope, torch.ones_like(slope))


@pytest.mark.parametrize("observation_std", [0.1, 1.5])
def test_the_belief_from_three_starts_is_a_sum_over_the_starts(dense_joint, condition, observation_std):
    process = MountainHike("multi", observation_std)
    state, observation, action = draw(process, 4, 6)
    belief, evidence = process.exact_filter(observation, action)

    length, steps = 6, step_of(action)
    system = process.system()
    for row in range(4):
        past, weighted, weights = observation[row].flatten(), [], []
        for start in range(3):
            joint = dense_joint(system, steps[row], start)
            last, seen = list(range(2 * length - 2, 2 * length)), list(range(2 * length, 4 * length))
            gain, offset, covariance, density = condition(*joint, last, seen)
            of_state = torch.distributions.MultivariateNormal(gain @ past + offset, covariance)
            weights.append(density.log_prob(past) - math.log(3))
            weighted.append(weights[-1] + of_state.log_prob(state[row, -1]))
        log_evidence = torch.stack(weights).logsumexp(0)
        torch.testing.assert_close(evidence[row].sum(), log_evidence)
        torch.testing.assert_close(belief.log_prob(state)[row, -1], torch.stack(weighted).logsumexp(0) - log_evidence)


@pytest.mark.parametrize(("observation_std", "steps", "share"), [(0.1, 1, 0), (1.5, 5, 0.5), (1.5, 10, 0.2)])
def test_starts_stay_ambiguous_for_as_long_as_the_class_says(observation_std, steps, share):
    process = MountainHike("multi", observation_std)

    belief = process.exact_filter(*draw(process, 500, steps)[1:]).belief

    unsure = (belief.log_weight[:, -1].exp().amax(-1) < 0.95).double().mean()
    assert unsure.item() == pytest.approx(share, abs=0.1)


@pytest.mark.parametrize(("start", "observation_std"), [("single", 0.1), ("multi", 1.0)])
def test_the_evidence_is_that_of_particle_filters(evidence_ratios, start, observation_std):
    process = MountainHike(start, observation_std)
    _, observation, action = draw(process, 1, 8)

    ratio = evidence_ratios(process, observation, action, filters=100, particles=2000)

    assert abs(ratio.mean() - 1) < 4 * ratio.std() / math.sqrt(len(ratio))
    assert ratio.std() < 0.5  # else the line above says little


def test_the_exact_smoothing_conditional_weighs_every_path_alike():
    process = MountainHike()
    state, observation, action = draw(process, 5, 12)

    exact = process.exact_smoothing_conditional(observation, action)

    joint = process.log_initial(state[:, 0]) + process.log_observation(observation, state).sum(1)
    joint += process.log_transition(state[:, 1:], state[:, :-1], action[:, 1:]).sum(1)
    posterior = exact.at(0, torch.zeros_like(state[:, 0])).log_prob(state[:, 0])
    for time in range(1, 12):
        posterior += exact.at(time, state[:, time - 1]).log_prob(state[:, time])
    torch.testing.assert_close(joint - posterior, process.log_likelihood(observation, action), rtol=0, atol=1e-9)


def test_with_several_starts_smoothing_is_not_gaussian():
    process = MountainHike("multi")

    assert process.exact_smoothing_conditional(*draw(process, 2, 3)[1:]) is None


def test_several_starts_are_drawn_alike():
    state = draw(MountainHike("multi"), 3000, 1).state[:, 0]  # (3000, 2)

    nearest = torch.cdist(state, torch.tensor(STARTS["multi"], dtype=torch.float64)).argmin(-1)

    share = nearest.bincount(minlength=3) / len(state)
    assert ((share - 1 / 3).abs() < 4 * math.sqrt(2 / 9 / len(state))).all()


def test_a_start_that_does_not_exist_is_one_sentence():
    with pytest.raises(
        ForbesError, match=r"^MountainHike: start is 'top', expected single or multi\. Choose one of them$"
    ):
        MountainHike("top")
