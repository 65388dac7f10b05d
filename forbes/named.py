"""A name for what is made from numbers, so that a record says what was measured: `Tiger(accuracy=0.85)`."""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

__all__ = ["Named"]


class Named:
    """Its `repr` is the class with the arguments it was made with, defaults included, but for those that are None.

    The arguments are noted when a subclass is constructed, so a subclass does nothing for its name.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in cls.__dict__:
            cls.__init__ = _noting(cls.__init__)  # type: ignore[method-assign]

    def __repr__(self) -> str:
        arguments: dict[str, Any] = self.__dict__.get("_made_with", {})
        listed = ", ".join(f"{name}={value}" for name, value in arguments.items() if value is not None)
        return f"{type(self).__name__}({listed})"


def _noting(init: Callable[..., None]) -> Callable[..., None]:
    """Let a constructor note its arguments; of several in a row the outermost does."""
    signature = inspect.signature(init)

    @wraps(init)
    def noting(self: Named, *args: Any, **kwargs: Any) -> None:
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        _, *arguments = bound.arguments.items()
        self.__dict__.setdefault("_made_with", dict(arguments))
        init(self, *args, **kwargs)

    return noting
