"""Curves in a terminal, of braille dots: two columns and four rows in each character."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["curve"]

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_EMPTY = 0x2800


def curve(x: Sequence[float], y: Sequence[float], width: int = 80, height: int = 8) -> list[str]:
    """Draw y against x as lines of text.

    If the lowest value is among the first tenth, values below the 5 % quantile are drawn on the lowest row, marked ≤,
    since the first updates may be far below all later ones.

    Args:
        x: increasing, N values.
        y: N values; those that are not finite are left out.
        width: columns, with the labels.
        height: rows, without the line of x.
    """
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    kept = np.isfinite(xs) & np.isfinite(ys)
    xs, ys = xs[kept], ys[kept]
    if not len(ys):
        return ["no finite value"]
    rises = ys.argmin() < len(ys) / 10
    low, high = float(np.quantile(ys, 0.05) if rises else ys.min()), float(ys.max())
    below = "≤ " if ys.min() < low else ""
    labels = [_number(high), *[""] * (height - 2), below + _number(low)]
    margin = max(map(len, labels))
    columns = width - margin - 2
    canvas = _dots(xs, np.clip(ys, low, high), low, high, columns, height)
    lines = [f"{label:>{margin}} ┤{''.join(map(chr, row))}" for label, row in zip(labels, canvas, strict=True)]
    first, last = _number(float(xs[0])), _number(float(xs[-1]))
    return [*(line.rstrip("⠀") for line in lines), f"{'':>{margin + 2}}{first}{last:>{columns - len(first)}}"]


def _dots(
    x: NDArray[np.float64], y: NDArray[np.float64], low: float, high: float, columns: int, rows: int
) -> NDArray[np.int64]:
    """Return the characters `(rows, columns)` of a polygon through the points, from low to high."""
    dense = np.linspace(x[0], x[-1], 8 * columns)
    across = np.rint(np.linspace(0, 2 * columns - 1, len(dense))).astype(int)
    share = (np.interp(dense, x, y) - low) / (high - low) if high > low else np.full(len(dense), 0.5)
    down = np.rint((1 - share) * (4 * rows - 1)).astype(int)
    canvas = np.full((rows, columns), _EMPTY)
    for column, row in zip(across, down, strict=True):
        canvas[row // 4, column // 2] |= _DOTS[row % 4][column % 2]
    return canvas


def _number(value: float) -> str:
    """Write a number with about four digits."""
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.4g}"
