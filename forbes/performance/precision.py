"""Where numbers stay in float32 although a training is in mixed precision (`--trainer.precision bf16-mixed`)."""

import torch
from torch import Tensor

__all__ = ["full_precision"]


def full_precision(near: Tensor) -> torch.autocast:
    """Switch autocast off on the device of a tensor; where none is on, nothing changes.

    bfloat16 has three digits. A recurrence adds up what they lose, a flow's inverse no longer inverts it, and a
    log-density of 10,000 nats would be known to 32 of them.
    """
    return torch.autocast(near.device.type, enabled=False)
