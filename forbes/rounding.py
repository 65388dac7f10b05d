"""Integer division, rounded up."""

from typing import TypeVar

from torch import Tensor

__all__ = ["ceil_div"]

Integer = TypeVar("Integer", int, Tensor)


def ceil_div(number: Integer, divisor: int) -> Integer:
    """Return number / divisor, rounded up to an integer."""
    return -(-number // divisor)
