"""The normal density against torch.distributions."""

import pytest
import torch
from torch.distributions import Normal

from forbes.densities import log_normal


@pytest.mark.parametrize("std", [0.3, torch.tensor([[0.5], [2.0]], dtype=torch.float64)])
def test_log_normal_is_that_of_torch(std):
    generator = torch.Generator().manual_seed(0)
    value, mean = torch.randn(2, 2, 5, generator=generator, dtype=torch.float64)

    torch.testing.assert_close(log_normal(value, mean, std), Normal(mean, std).log_prob(value))
