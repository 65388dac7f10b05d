"""The light-dark problem: the belief is over the start, moves with the walker, and has a notch at the light."""

import math

import torch

from forbes.pomdps import LightDark
from forbes.pomdps.grid import grid_filter


def draw(process, sequences, length, seed=0):
    return process.sample(sequences, length, torch.Generator().manual_seed(seed))


def test_one_step_is_what_the_grid_filter_says():
    process = LightDark(50)
    _, observation, action = draw(process, 4, 1)

    own = process.exact_filter(observation, action)
    general = grid_filter(process, process.grid, observation, action)

    torch.testing.assert_close(own.step_log_likelihood, general.step_log_likelihood)
    torch.testing.assert_close(own.belief.log_mass, general.belief.log_mass)


def test_steps_go_left_and_right_by_one():
    state, _, action = draw(LightDark(50), 200, 20)

    torch.testing.assert_close(state.diff(dim=1), action[:, 1:])
    steps = action[:, 1:]
    assert (steps.abs() == 1).all()
    assert abs(steps.mean()) < 4 / math.sqrt(steps.numel())


def test_the_belief_is_one_over_the_start_moved_with_the_walker():
    process = LightDark(50)
    _, observation, action = draw(process, 3, 6)

    belief = process.exact_filter(observation, action).belief

    start = process.grid.centres[1300:1400].view(-1, 1, 1, 1)  # two units about the light, (100, 1, 1, 1)
    moved = start + action.cumsum(1)  # (100, B, T, 1)
    joint = process.log_initial(start) + process.log_observation(observation, moved).cumsum(-1)  # (100, B, T)
    odds = belief.log_prob(moved).diff(dim=0)  # of neighbouring starts
    torch.testing.assert_close(odds, joint.diff(dim=0))


def test_the_grid_is_as_good_as_is_stated():
    """No error for most walks, and at most 6e-3 nats for one that is seen to pass the light."""
    generator = torch.Generator().manual_seed(0)
    _, observation, action = draw(LightDark(), 9, 12)
    near = torch.tensor([4.992, 4.995, 4.998, 5.0, 5.001, 5.003, 5.008, 5.01, 5.02], dtype=torch.float64)
    passing = LightDark().emission(near.view(9, 1, 1) + action.cumsum(1)).sample(1, generator)[0]

    def error(observation):
        fine = LightDark(1000).log_likelihood(observation, action)
        return (LightDark().log_likelihood(observation, action) - fine).abs()

    assert error(observation).median() < 1e-12
    assert error(passing).max() < 6e-3


def test_an_observation_far_from_the_light_leaves_a_notch_at_it():
    process = LightDark()
    observation, action = torch.full((1, 1, 1), 4.0), torch.zeros(1, 1, 1)

    belief = process.exact_filter(observation, action).belief

    at = belief.log_prob(torch.tensor([3.5, 5.0, 6.0], dtype=torch.float64).view(3, 1, 1, 1)).flatten()
    assert at[1] < at[0] - 100
    assert at[1] < at[2] - 100
