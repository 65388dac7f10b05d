"""Compare two stroke sets of the same digits: common pixels, distance, and order of writing."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.data.strokes.file import SIDE, StrokeArrays
from forbes.errors import ForbesError

__all__ = ["PathSimilarity", "compare_digits", "compare_sets"]


class PathSimilarity(NamedTuple):
    """Similarity of two pen paths of one digit."""

    iou: float
    """Intersection over union of the visited pixels."""
    chamfer: float
    """Mean distance in pixels from a pixel to the nearest pixel of the other path, averaged over both directions."""
    order: float
    """Absolute Spearman correlation of first visits on the common pixels; NaN with fewer than 3 common pixels."""


def compare_digits(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> PathSimilarity:
    """Compare two paths, each uint8 (P, 2)."""
    (a, visit_a), (b, visit_b) = (np.unique(_pixel_numbers(path), return_index=True) for path in (one, other))
    common, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    gap = np.stack(np.divmod(a, SIDE), -1)[:, None] - np.stack(np.divmod(b, SIDE), -1)  # (A, B, 2)
    distance = np.sqrt((gap**2).sum(-1))  # (A, B)
    return PathSimilarity(
        iou=len(common) / (len(a) + len(b) - len(common)),
        chamfer=float(distance.min(1).mean() + distance.min(0).mean()) / 2,
        order=_rank_correlation(visit_a[in_a], visit_b[in_b]),
    )


def _pixel_numbers(path: NDArray[np.uint8]) -> NDArray[np.int64]:
    return path[:, 1].astype(np.int64) * SIDE + path[:, 0]


def _rank_correlation(one: NDArray[np.int64], other: NDArray[np.int64]) -> float:
    """Return the absolute Spearman correlation of values without ties, |1 − 6 Σ d² / (n³ − n)|."""
    n = len(one)
    if n < 3:
        return float("nan")
    difference = one.argsort().argsort() - other.argsort().argsort()
    return abs(1 - 6 * float((difference**2).sum()) / (n**3 - n))


def compare_sets(one: StrokeArrays, other: StrokeArrays) -> dict[str, tuple[float, ...]]:
    """Compare two sets of the same digits.

    Returns:
        The value of each measure, or one value per set.
    """
    if not np.array_equal(one.labels, other.labels):
        raise ForbesError("the two sets have different labels, expected the same digits in the same order.")
    sets = (one, other)
    paths = zip(*(np.split(arrays.points, arrays.offsets[1:-1]) for arrays in sets), strict=True)
    scores = np.array([compare_digits(a, b) for a, b in paths])  # (N, 3)
    lengths = [np.diff(arrays.offsets) for arrays in sets]
    return {
        "pixel IoU, mean": (float(scores[:, 0].mean()),),
        "Chamfer distance in pixels, mean": (float(scores[:, 1].mean()),),
        "order correlation, mean": (float(np.nanmean(scores[:, 2])),),
        "order correlation, median": (float(np.nanmedian(scores[:, 2])),),
        "points per digit, median": tuple(float(np.median(length)) for length in lengths),
        "points per digit, mean": tuple(float(length.mean()) for length in lengths),
        "strokes per digit, mean": tuple(float(arrays.pen_up.sum() / len(arrays.labels)) for arrays in sets),
    }
