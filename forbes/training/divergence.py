"""Divergence: no step is made with a loss or gradient that is not finite."""

import math

import torch
from torch import Tensor
from torch.optim import Optimizer

from forbes.errors import ForbesError

__all__ = ["DivergedError", "hold_unless_finite"]


class DivergedError(ForbesError):
    """A loss, a gradient or a parameter is not finite.

    Args:
        message: one sentence.
        update: that is not, counted from 1.
    """

    exit_status = 3

    def __init__(self, message: str, update: int) -> None:
        super().__init__(message)
        self.update = update


def hold_unless_finite(optimizer: Optimizer, value: Tensor, update: int) -> None:
    """Hold an optimiser from the first update on in which a value is not finite: its steps then change nothing.

    Nothing waits for the device. A fused optimiser reads `found_inf` there, as it does for a scaler of gradients.

    Args:
        optimizer: whose step comes next.
        value: a loss or the norm of a gradient, a scalar.
        update: number of the update at hand, from 0.
    """
    state = vars(optimizer)
    held = torch.where(value.detach().isfinite(), math.inf, float(update))  # ()
    state["held_from"] = torch.minimum(state["held_from"], held) if "held_from" in state else held
    state["found_inf"] = state["held_from"].isfinite().float()
