"""The T-maze: where the actions lead, and what is remembered of the sign."""

import math

import pytest
import torch
from torch.nn.functional import one_hot

from forbes.errors import ForbesError
from forbes.pomdps import TMaze
from forbes.pomdps.t_maze import DOWN, LEFT, RIGHT, UP


def walk(process, moves, start=0):
    """The state after some actions, where nothing is random."""
    state = one_hot(torch.tensor(start), process.state_dim).double()
    for move in moves:
        action = one_hot(torch.tensor(move), 4).double()
        state = process.transition(state, action).mean
    return int(state.argmax())


def test_actions_lead_along_the_corridor_and_into_the_arms():
    process, places = TMaze(3), 6

    for first in (0, places):  # goal up, goal down
        assert walk(process, [RIGHT, RIGHT, LEFT], first) == first + 1
        assert walk(process, [LEFT, UP, DOWN], first) == first  # walls
        assert walk(process, [RIGHT] * 5, first) == first + 3  # the crossroad
        assert walk(process, [RIGHT] * 3 + [LEFT], first) == first + 2
        assert walk(process, [RIGHT] * 3 + [UP], first) == first + 4
        assert walk(process, [RIGHT] * 3 + [DOWN, LEFT, UP, RIGHT], first) == first + 5  # never left


def test_a_stochastic_action_is_replaced_by_any_of_the_four():
    process = TMaze(3, stochasticity=0.2)
    crossroad = one_hot(torch.tensor(3), process.state_dim).double()

    after = process.transition(crossroad, one_hot(torch.tensor(UP), 4).double()).mean

    expected = {4: 1 - 3 * 0.05, 2: 0.05, 3: 0.05, 5: 0.05}  # the arm meant, back, the wall, the other arm
    assert {place: pytest.approx(value) for place, value in expected.items()} == {
        place: after[place].item() for place in after.nonzero().flatten().tolist()
    }


def test_the_sign_is_never_forgotten():
    process = TMaze(5, stochasticity=0.2)
    _, observation, action = process.sample(50, 20, torch.Generator().manual_seed(0))

    exact = process.exact_filter(observation, action)

    up = exact.belief.mean[..., :8].sum(-1)  # (B, T)
    torch.testing.assert_close(up, observation[:, :1, 0].expand(-1, 20))
    torch.testing.assert_close(exact.step_log_likelihood[:, 0], torch.full((50,), math.log(0.5), dtype=torch.float64))


@pytest.mark.parametrize("stochasticity", [-0.1, 1.1, math.nan])
def test_a_stochasticity_is_a_probability(stochasticity):
    with pytest.raises(ForbesError, match=r"^TMaze: stochasticity is .*, expected a probability"):
        TMaze(stochasticity=stochasticity)


def test_a_corridor_has_a_length():
    with pytest.raises(ForbesError, match=r"^TMaze: length is 0, expected more than 0"):
        TMaze(0)
