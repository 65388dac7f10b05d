"""Symlog, and the two-hot code of a number."""

import pytest
import torch

from forbes.symlog import symexp, symlog, two_hot


def numbers():
    return torch.tensor([-1e6, -3.0, -1e-9, 0.0, 1e-9, 0.5, 3.0, 1e6], dtype=torch.float64)


def test_symexp_is_the_inverse_of_symlog():
    torch.testing.assert_close(symexp(symlog(numbers())), numbers())


def test_symlog_is_odd_and_about_x_near_zero():
    assert torch.equal(symlog(-numbers()), -symlog(numbers()))
    assert symlog(torch.tensor(1e-9, dtype=torch.float64)).item() == pytest.approx(1e-9, rel=1e-8)


@pytest.mark.parametrize("bins", [torch.linspace(-5, 5, 11), symexp(torch.linspace(-3, 3, 8))])
def test_the_mean_of_a_two_hot_code_is_the_number(bins):
    bins = bins.double()
    value = torch.empty(100, 3, dtype=torch.float64).uniform_(
        bins[0].item(), bins[-1].item(), generator=torch.Generator().manual_seed(0)
    )

    weights = two_hot(value, bins)

    torch.testing.assert_close((weights * bins).sum(-1), value)
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(value))
    assert (weights >= 0).all()
    assert ((weights > 0).sum(-1) <= 2).all()


def test_the_code_of_a_bin_is_one_hot():
    bins = torch.linspace(-5, 5, 11, dtype=torch.float64)

    torch.testing.assert_close(two_hot(bins, bins), torch.eye(11, dtype=torch.float64))


def test_numbers_beyond_the_bins_become_the_outermost():
    bins = torch.linspace(-5, 5, 11, dtype=torch.float64)

    torch.testing.assert_close(two_hot(torch.tensor([-99.0, 99.0]).double(), bins), two_hot(bins[[0, -1]], bins))
