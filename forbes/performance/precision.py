"""Computations that stay in float32 in a mixed-precision training (`--trainer.precision bf16-mixed`)."""

import torch
from torch import Tensor

__all__ = ["full_precision"]


def full_precision(near: Tensor) -> torch.autocast:
    """Switch autocast off on the device of a tensor. Without autocast, nothing changes.

    bfloat16 has three digits. In a recurrence rounding errors accumulate, a flow's inverse no longer inverts it, and a
    log-density of 10,000 nats is rounded to multiples of 64.
    """
    return torch.autocast(near.device.type, enabled=False)
