"""Random numbers that are a pure function of a seed."""

import torch

from forbes.seeding import forked


def test_forked_seeds_inside_and_restores_outside():
    torch.manual_seed(3)
    expected = torch.randn(2)

    torch.manual_seed(3)
    with forked("cpu", 7):
        inside = torch.randn(2)
    after = torch.randn(2)

    torch.manual_seed(7)
    assert torch.equal(inside, torch.randn(2))
    assert torch.equal(after, expected)
