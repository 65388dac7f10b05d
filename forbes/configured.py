"""Classes whose instances are built later, when their sizes are known: `FlowBelief.configured(layers=3)`."""

from collections.abc import Callable
from functools import partial
from typing import Any, Self

__all__ = ["Configurable"]


class Configurable:
    """A class whose sizes are determined by the model that instantiates it.

    Example:
        >>> from forbes import FlowBelief
        >>> family = FlowBelief.configured(layers=3)
        >>> head = family(2, 16)  # state_dim, context_dim
        >>> type(head).__name__, head.state_dim
        ('FlowBelief', 2)
    """

    @classmethod
    def configured(cls, **options: Any) -> Callable[..., Self]:
        """Return a function that builds an instance with these options.

        Args:
            **options: constructor arguments by name, except the sizes.
        """
        return partial(cls, **options)
