"""Print records of tensors by shape and dtype instead of values."""

from typing import Any, TypeVar

__all__ = ["printed_by_shape"]

Record = TypeVar("Record")


def printed_by_shape(record: type[Record]) -> type[Record]:
    """Decorate a NamedTuple of tensors or arrays to print as `Batch(observation=uint8 (2, 30, 1, 28, 28), ...)`."""

    def __repr__(self: Any) -> str:  # noqa: N807
        fields = (f"{name}={_summary(getattr(self, name))}" for name in self._fields)
        return f"{type(self).__name__}({', '.join(fields)})"

    record.__repr__ = __repr__  # type: ignore[method-assign]
    return record


def _summary(value: Any) -> str:
    """Return dtype, shape and device (unless it is the CPU) of a tensor or array, or the repr of another value."""
    if not hasattr(value, "shape"):
        return repr(value)
    device = str(getattr(value, "device", "cpu"))
    suffix = "" if device == "cpu" else f" on {device}"
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}{suffix}"
