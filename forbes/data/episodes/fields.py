"""The fields of an episode's record, as read from JSON, and what is wrong with them."""

import math
from collections.abc import Callable
from typing import Any

from forbes.factors import as_discrete, problem_of_discrete
from forbes.reading import is_number, shortened
from forbes.shapes import is_shape

__all__ = ["FITS", "problem_of_environment"]

_SHOWN = 60  # characters of an invalid value in an error message

FITS: dict[Any, Callable[[Any], bool]] = {
    int: lambda value: type(value) is int and 0 <= value < 2**63,
    float: lambda value: is_number(value) and -math.inf < value < math.inf,
    bool: lambda value: type(value) is bool,
    str: lambda value: type(value) is str,
    dict[str, Any]: lambda value: type(value) is dict,
}
"""Whether a value has the type of a field."""
_ENVIRONMENT: dict[str, Callable[[Any], bool]] = {
    "task": FITS[str],
    "observation_shape": lambda value: type(value) in (list, dict) and is_shape(value),
    "action_dim": lambda value: _is_size(value),
    "discrete": lambda value: type(value) is bool or (type(value) is list and all(map(_is_size, value))),
}
"""Required fields of a record's environment, with a check of their values."""


def _is_size(value: Any) -> bool:
    return FITS[int](value) and value > 0


def problem_of_environment(environment: dict[str, Any]) -> str:
    """Return what is wrong with the environment of a record, or an empty string."""
    for name, fits in _ENVIRONMENT.items():
        if name not in environment:
            return f"its environment has no {name}, expected the result of `describe_environment`"
        if not fits(value := environment[name]):
            return f"its environment's {name} is {shortened(str(value), _SHOWN)}"
    if problem := problem_of_discrete(as_discrete(environment["discrete"]), environment["action_dim"]):
        return f"its environment's {problem}"
    return "" if type(environment.get("made_by", {})) is dict else "its environment's made_by is not a mapping"
