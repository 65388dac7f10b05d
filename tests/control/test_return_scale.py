"""The running range of the returns."""

import pytest
import torch

from forbes.control.return_scale import ReturnScale

VALID = torch.ones(1000, dtype=torch.bool)


def returns(scale):
    return scale * torch.rand(1000, 14, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("scale", [10.0, 1000.0])
def test_it_comes_to_nine_tenths_of_a_uniform_range(scale):
    """The 5th and 95th percentiles of U(0, s) are 0.9 s apart; 14,000 draws know each to 0.002 s (binomial)."""
    ours = ReturnScale(decay=0.5)

    for _ in range(30):
        found = ours(returns(scale), VALID)

    torch.testing.assert_close(found.item(), 0.9 * scale, rtol=0.01, atol=0)


def test_the_average_starts_at_zero_and_decays():
    ours = ReturnScale(decay=0.9)
    low, high = (returns(100.0).quantile(at) for at in (0.05, 0.95))

    found = [ours(returns(100.0), VALID) for _ in range(3)]

    torch.testing.assert_close(torch.stack(found), (high - low) * (1 - 0.9 ** torch.arange(1.0, 4)))


def test_small_returns_are_not_scaled_up():
    assert ReturnScale(decay=0.0)(returns(0.1), VALID) == 1


def test_an_evaluation_changes_nothing():
    ours = ReturnScale(decay=0.0).eval()

    assert ours(returns(100.0), VALID) == 1
    assert ours.percentiles.tolist() == [0, 0]


def test_trajectories_that_start_on_padding_do_not_count():
    values, valid = returns(100.0), torch.arange(1000) % 2 == 0
    padded = values.masked_fill(~valid[:, None], 1e6)

    assert ReturnScale(decay=0.0)(padded, valid) == ReturnScale(decay=0.0)(values[::2], valid[::2])
