"""Sequences for a model, of which a test says what matters to it."""

import torch

from forbes.data import SequenceBatch

__all__ = ["batch_of"]


def batch_of(observation, action, reward=None, mask=None):
    """Return a batch of sequences `(B, T, ...)`: no reward, whole, without states and ends unless given."""
    zeros = torch.zeros(observation.shape[:2])
    return SequenceBatch(
        observation=observation,
        action=action,
        reward=zeros if reward is None else reward,
        mask=zeros == 0 if mask is None else mask,
        state=torch.zeros(*zeros.shape, 0),
        ended=zeros > 0,
    )
