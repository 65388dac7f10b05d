"""The grid filter against closed forms, against finer grids, and against particle filters."""

import math

import pytest
import torch

from forbes.errors import ForbesError
from forbes.pomdps import LightDark, LinearGaussian, MirrorSensor, Ungm
from forbes.pomdps.grid import Grid, grid_filter


def draw(process, sequences, length, seed=0):
    return process.sample(sequences, length, torch.Generator().manual_seed(seed))


def test_of_a_linear_gaussian_it_is_the_kalman_filter():
    process = LinearGaussian(0.9, 0.3, 0.5)
    _, observation, action = draw(process, 3, 12)

    kalman = process.exact_filter(observation, action)
    grid = grid_filter(process, Grid(-12, 12, 241), observation, action)

    torch.testing.assert_close(grid.step_log_likelihood, kalman.step_log_likelihood, rtol=0, atol=1e-10)
    torch.testing.assert_close(grid.belief.mean, kalman.belief.mean, rtol=0, atol=1e-10)
    within = grid.belief.width**2 / 12  # a cell is as wide as it is
    torch.testing.assert_close(grid.belief.variance - within, kalman.belief.variance, rtol=0, atol=1e-10)
    torch.testing.assert_close(grid.belief.entropy, kalman.belief.entropy, rtol=0, atol=1e-10)


# The mean error that each class states, times two: few sequences have most of it.
@pytest.mark.parametrize(
    ("coarse", "fine", "error"),
    [
        (Ungm(451), Ungm(901), 4e-4),
        (Ungm(901), Ungm(1201), 1e-9),
        (MirrorSensor(cells=401), MirrorSensor(cells=1601), 1e-5),
    ],
    ids=["ungm-451", "ungm-901", "mirror-401"],
)
def test_a_finer_grid_changes_the_evidence_as_little_as_stated(coarse, fine, error):
    _, observation, action = draw(coarse, 6, 30)

    difference = coarse.log_likelihood(observation, action) - fine.log_likelihood(observation, action)

    assert difference.abs().mean() < 2 * error


@pytest.mark.parametrize(
    "process", [Ungm(), MirrorSensor(cells=801), LightDark()], ids=["ungm", "mirror", "light-dark"]
)
def test_the_evidence_is_that_of_particle_filters(evidence_ratios, process):
    _, observation, action = draw(process, 1, 8, seed=2)

    ratio = evidence_ratios(process, observation, action, filters=100, particles=3000)

    assert abs(ratio.mean() - 1) < 4 * ratio.std() / math.sqrt(len(ratio))
    assert ratio.std() < 0.5  # else the line above says little


def test_a_kink_costs_least_where_the_grid_puts_it():
    r"""∫ exp(-|x - k|) dx = 2: the error of a grid that ignores the kink falls with the square of the width only."""
    for kink in (0.0, 0.123):
        errors = []
        for cells in (1001, 2001):
            grid = Grid.around_kink(-50, 50, cells, kink)
            assert 0 <= grid.first + 50 + grid.width < 2 * grid.width  # moved by less than a cell
            assert grid.last - grid.first == pytest.approx(100)
            errors.append(abs((-(grid.centres - kink).abs()).exp().sum() * grid.width - 2).item())
        plain = Grid(-50, 50, 1001)
        unaware = abs((-(plain.centres - kink).abs()).exp().sum() * plain.width - 2).item()
        assert errors[0] < unaware / 100
        assert errors[0] / errors[1] > 15  # fourth order, by symmetry


def test_sequences_of_one_batch_may_act_differently():
    process = Ungm(451)
    _, observation, action = draw(process, 3, 6)
    action = action * torch.tensor([1.0, -0.5, 1.0])[:, None, None]

    together = process.exact_filter(observation, action)

    for row in range(3):
        alone = process.exact_filter(observation[row : row + 1], action[row : row + 1])
        torch.testing.assert_close(together.step_log_likelihood[row], alone.step_log_likelihood[0])
        torch.testing.assert_close(together.belief.mean[row], alone.belief.mean[0])


@pytest.mark.parametrize(
    "process", [MirrorSensor(cells=401), Ungm(451), LightDark(20)], ids=["mirror", "ungm", "light"]
)
def test_a_belief_that_leaves_the_grid_is_one_clear_sentence(process):
    _, observation, action = draw(process, 2, 3)
    observation[1, 2] = 1e6

    message = f"^{type(process).__name__}: the belief of sequence 1 at step 2 reaches the end of the grid"
    with pytest.raises(ForbesError, match=message):
        process.exact_filter(observation, action)
