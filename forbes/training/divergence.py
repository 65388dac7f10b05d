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
        update: number of the first update that is not finite, counted from 1.
    """

    exit_status = 3

    def __init__(self, message: str, update: int) -> None:
        super().__init__(message)
        self.update = update


def hold_unless_finite(optimizer: Optimizer, value: Tensor, update: int) -> None:
    """Let an optimiser change nothing from the first update on in which a value is not finite.

    A fused optimiser reads `found_inf` on the device, as it does for a gradient scaler. Nothing synchronises with it.

    Args:
        optimizer: the optimiser that is about to step.
        value: a loss or the norm of a gradient, a scalar.
        update: number of the current update, counted from 0.
    """
    state = vars(optimizer)
    held = torch.where(value.detach().isfinite(), math.inf, float(update))  # ()
    state["held_from"] = torch.minimum(state["held_from"], held) if "held_from" in state else held
    state["found_inf"] = state["held_from"].isfinite().float()
