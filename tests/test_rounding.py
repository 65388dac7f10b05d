"""Integer division, rounded up."""

import math

import torch

from forbes.rounding import ceil_div


def test_ceil_div_is_the_ceiling_of_the_quotient():
    numbers = range(-7, 8)

    assert [ceil_div(number, 3) for number in numbers] == [math.ceil(number / 3) for number in numbers]
    assert ceil_div(torch.tensor([*numbers]), 3).tolist() == [ceil_div(number, 3) for number in numbers]
