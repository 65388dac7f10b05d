"""What tests of models share."""

import pytest
import torch


@pytest.fixture
def same_noise(monkeypatch):
    """Make every draw the same vector: then no step and no row can differ by its noise."""

    def vector(shape, low, **options):
        return torch.linspace(low, 1, shape[-1], **options).expand(shape)

    def of(values, low):
        return vector(values.shape, low, dtype=values.dtype)

    monkeypatch.setattr(torch, "randn", lambda *shape, **options: vector(shape, -1, **options))
    monkeypatch.setattr(torch, "randn_like", lambda values: of(values, -1))
    monkeypatch.setattr(torch, "rand_like", lambda values: of(values, 0.5) - 0.25)  # within (0, 1)
    monkeypatch.setattr(torch.Tensor, "exponential_", lambda values: values.copy_(of(values, 0.5)))
