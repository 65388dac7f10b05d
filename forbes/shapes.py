"""Shapes of observations of one array or of several parts, and records that are printed by shape.

An observation of several parts is a dict of arrays or tensors by name, e.g. `{"camera": image, "proprio": vector}`.
Wherever the parts have an order, it is that of their names.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, TypeVar

__all__ = ["NAMES", "Observed", "Shape", "is_names", "is_shape", "map_parts", "part_name", "plain_shape"]
__all__ += ["printed_by_shape", "shape_of", "size_of"]

Record = TypeVar("Record")

Observed: TypeAlias = Any
"""An array or a tensor, or a dict of them by the names of the parts. Models read it by `Likelihood.target` only."""
Shape: TypeAlias = tuple[int, ...] | dict[str, tuple[int, ...]]
"""Shape of an observation: `(C, H, W)` of an image, `(O,)` of a vector, or these by the names of the parts."""
NAMES = "letters, digits, _ and - in the names of parts, and at least one part"


def is_names(parts: Mapping[Any, Any]) -> bool:
    """Return whether the names of parts are valid, so that they can be those of files and metrics."""
    valid = (isinstance(name, str) and re.fullmatch("[A-Za-z0-9][A-Za-z0-9_-]*", name) for name in parts)
    return len(parts) > 0 and all(valid)


def part_name(key: str) -> str:
    """Return a valid name of a part for a key of other software: `observation_images_top`."""
    return re.sub("[^A-Za-z0-9_-]", "_", key).lstrip("_-") or "part"


def is_shape(value: Any) -> bool:
    """Return whether a value, as it is or as read from JSON, is the shape of an observation."""
    if isinstance(value, Mapping):
        return is_names(value) and all(map(_is_shape_of_array, value.values()))
    return _is_shape_of_array(value)


def _is_shape_of_array(value: Any) -> bool:
    def is_size(side: Any) -> bool:
        whole = hasattr(side, "__index__") and not isinstance(side, bool)
        return whole and 0 < int(side) < 2**63

    return isinstance(value, tuple | list) and len(value) in (1, 3) and all(map(is_size, value))


def shape_of(value: Any) -> Shape:
    """Return a shape that was read from JSON: tuples instead of lists, parts in the order of their names."""
    if isinstance(value, Mapping):
        return {name: tuple(value[name]) for name in sorted(value)}
    return tuple(value)


def plain_shape(shape: Shape) -> list[int] | dict[str, list[int]]:
    """Return a shape as JSON has it: the inverse of `shape_of`."""
    if isinstance(shape, Mapping):
        return {name: list(shape[name]) for name in sorted(shape)}
    return list(shape)


def size_of(shape: Shape) -> int:
    """Return the number of values of an observation."""
    return sum(map(math.prod, shape.values())) if isinstance(shape, Mapping) else math.prod(shape)


def map_parts(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Apply a function to values, or to each part of mappings of them, which have the same names.

    Example:
        >>> map_parts(len, [1, 2]), map_parts(len, {"camera": [1], "proprio": [1, 2]})
        (2, {'camera': 1, 'proprio': 2})
    """
    if isinstance(first, Mapping):
        return {name: function(first[name], *(other[name] for other in others)) for name in sorted(first)}
    return function(first, *others)


def printed_by_shape(record: type[Record]) -> type[Record]:
    """Decorate a NamedTuple of tensors or arrays to print as `Batch(observation=uint8 (2, 30, 1, 28, 28), ...)`."""

    def __repr__(self: Any) -> str:  # noqa: N807
        fields = (f"{name}={_summary(getattr(self, name))}" for name in self._fields)
        return f"{type(self).__name__}({', '.join(fields)})"

    record.__repr__ = __repr__  # type: ignore[method-assign]
    return record


def _summary(value: Any) -> str:
    """Return dtype, shape and device (unless it is the CPU) of a tensor or array, or the repr of another value."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name}: {_summary(part)}' for name, part in value.items())}}}"
    if not hasattr(value, "shape"):
        return repr(value)
    device = str(getattr(value, "device", "cpu"))
    suffix = "" if device == "cpu" else f" on {device}"
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}{suffix}"
