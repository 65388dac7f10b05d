"""What tests of models share."""

import pytest
import torch


@pytest.fixture
def same_noise(monkeypatch):
    """Make every draw the same vector: then no step and no row can differ by its noise."""

    def randn(*shape, **options):
        return torch.linspace(-1, 1, shape[-1], **options).expand(shape)

    monkeypatch.setattr(torch, "randn", randn)
