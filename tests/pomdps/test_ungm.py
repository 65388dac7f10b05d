"""The growth model: its clock, and how often its belief has two modes."""

import math

import pytest
import torch

from forbes.pomdps import Ungm


def test_the_clock_is_the_same_for_all_and_starts_at_one():
    action = Ungm().sample(2, 4, torch.Generator()).action[..., 0]

    expected = torch.tensor([0.0, 1.0, math.cos(1.2), math.cos(2.4)], dtype=torch.float64)
    torch.testing.assert_close(action, expected.expand(2, -1))


def test_a_step_by_hand():
    state, action = torch.tensor([2.0], dtype=torch.float64), torch.tensor([0.5], dtype=torch.float64)

    moved, seen = Ungm().transition(state, action), Ungm().emission(state)

    assert moved.mean.item() == 1 + 10 + 4
    assert moved.std.item() ** 2 == pytest.approx(10)
    assert (seen.mean.item(), seen.std.item()) == (0.2, 1)


def test_the_belief_has_a_second_mode_at_three_steps_in_five():
    """The minor side of zero holds more than 5 % at 61 % of the steps, as is known of this model."""
    process = Ungm(451)
    _, observation, action = process.sample(150, 30, torch.Generator().manual_seed(0))

    belief = process.exact_filter(observation, action).belief

    left = belief.log_mass[..., belief.centres < 0].exp().sum(-1)  # (B, T)
    bimodal = (torch.minimum(left, 1 - left) > 0.05).double().mean(1)  # (B,)
    assert abs(bimodal.mean() - 0.61) < 4 * bimodal.std() / math.sqrt(150) + 0.005  # 0.61 is rounded
