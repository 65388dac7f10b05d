"""A `repr` with the constructor's arguments, for records: `Tiger(accuracy=0.85)`."""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

__all__ = ["Named"]


class Named:
    """Its `repr` is the class with its constructor arguments, including defaults, except those that are None.

    The arguments are recorded when an instance is constructed, without any code in the subclass.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in cls.__dict__:
            cls.__init__ = _recording(cls.__init__)  # type: ignore[method-assign]

    def __repr__(self) -> str:
        arguments: dict[str, Any] = self.__dict__.get("_arguments", {})
        listed = ", ".join(f"{name}={value}" for name, value in arguments.items() if value is not None)
        return f"{type(self).__name__}({listed})"


def _recording(init: Callable[..., None]) -> Callable[..., None]:
    """Wrap a constructor to record its arguments; with several nested constructors, the outermost one does."""
    signature = inspect.signature(init)

    @wraps(init)
    def recording(self: Named, *args: Any, **kwargs: Any) -> None:
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        _, *arguments = bound.arguments.items()
        self.__dict__.setdefault("_arguments", dict(arguments))
        init(self, *args, **kwargs)

    return recording
