"""The stroke file: pen paths of digits in one `.npz`, validated when read and reproducible when written.

For each split ``S`` in ``train``, ``test``:

=============  ==============  =====================================================
``S_points``   uint8 (P, 2)    pixels (column x, row y), 0 … 27, in writing order
``S_pen_up``   bool (P,)       true at the last point of each stroke
``S_offsets``  int32 (N + 1,)  digit i owns points ``offsets[i]:offsets[i + 1]``
``S_labels``   uint8 (N,)      the digit's class
=============  ==============  =====================================================
"""

import hashlib
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.errors import ForbesError
from forbes.files import npz_bytes, replace_file
from forbes.reading import readable
from forbes.shapes import printed_by_shape

__all__ = ["SIDE", "StrokeArrays", "check_strokes", "load_strokes", "save_strokes", "sha256_of_arrays"]

SIDE = 28
"""Height and width of a digit's image in pixels."""

_MEMBER_LIMIT = 64 * 2**20  # bytes of one array; the largest in the two known sets has 5 MB


@printed_by_shape
class StrokeArrays(NamedTuple):
    """The pen paths of one split's digits."""

    points: NDArray[np.uint8]
    """Pixels (x, y) in writing order, (P, 2)."""
    pen_up: NDArray[np.bool_]
    """True at the last point of each stroke, (P,)."""
    offsets: NDArray[np.int32]
    """Digit i owns points ``offsets[i]:offsets[i + 1]``, (N + 1,)."""
    labels: NDArray[np.uint8]
    """Class of each digit, (N,)."""


_EXPECTED: dict[str, tuple[str, str, int]] = {  # array -> dtype, shape in words, dimensions
    "points": ("uint8", "(points, 2)", 2),
    "pen_up": ("bool", "(points,)", 1),
    "offsets": ("int32", "(digits + 1,)", 1),
    "labels": ("uint8", "(digits,)", 1),
}


def load_strokes(path: Path, remedy: str) -> dict[str, StrokeArrays]:
    """Read and check a stroke file.

    Args:
        path: the `.npz` file.
        remedy: what to do if the file is missing or damaged; the last sentence of the error message.

    Returns:
        Arrays of the splits `train` and `test`.
    """
    if not path.is_file():
        raise ForbesError(f"{path}: no such file. {remedy}")
    with readable(path, "a stroke file", remedy), zipfile.ZipFile(path) as archive:
        splits = {
            split: StrokeArrays(*(_read_array(archive, path, f"{split}_{name}", remedy) for name in _EXPECTED))
            for split in ("train", "test")
        }
    check_strokes(splits, path, remedy)
    return splits


def _read_array(archive: zipfile.ZipFile, path: Path, name: str, remedy: str) -> NDArray[Any]:
    if f"{name}.npy" not in archive.namelist():
        raise ForbesError(f'{path}: array "{name}" is missing. {remedy}')
    member = archive.getinfo(f"{name}.npy")
    if member.file_size > _MEMBER_LIMIT:
        raise ValueError(f'array "{name}" has {member.file_size} bytes, expected at most {_MEMBER_LIMIT}')
    return np.lib.format.read_array(io.BytesIO(archive.read(member)), allow_pickle=False)


def check_strokes(splits: Mapping[str, StrokeArrays], where: Path, remedy: str) -> None:
    """Raise a `ForbesError` unless every array conforms to the format."""
    for split, arrays in splits.items():
        for name, array in arrays._asdict().items():
            dtype, shape, dimensions = _EXPECTED[name]
            label = f'{where}: array "{split}_{name}" has'
            if array.dtype != np.dtype(dtype):
                raise ForbesError(f"{label} dtype {array.dtype}, expected {dtype}. {remedy}")
            if array.ndim != dimensions or (name == "points" and array.shape[1] != 2):
                raise ForbesError(f"{label} shape {array.shape}, expected {shape}. {remedy}")
        problem = _find_problem(arrays)
        if problem:
            raise ForbesError(f"{where}: in split {split}, {problem}. {remedy}")


def _find_problem(arrays: StrokeArrays) -> str | None:
    points, pen_up, offsets, labels = arrays
    if len(pen_up) != len(points):
        return f"pen_up has {len(pen_up)} entries, expected one per point, {len(points)}"
    if len(offsets) != len(labels) + 1:
        return f"offsets has {len(offsets)} entries, expected one more than the {len(labels)} labels"
    if offsets[0] != 0 or offsets[-1] != len(points):
        return f"offsets run from {offsets[0]} to {offsets[-1]}, expected 0 to {len(points)}, the number of points"
    empty = np.flatnonzero(np.diff(offsets) <= 0)
    if len(empty):
        return f"offsets do not increase at digit {empty[0]}, expected at least one point per digit"
    if len(points) and points.max() >= SIDE:
        return f"a point has coordinate {points.max()}, expected 0 to {SIDE - 1}"
    if not pen_up[offsets[1:] - 1].all():
        return "a digit ends with the pen down, expected pen_up at its last point"
    if len(labels) and labels.max() > 9:
        return f"a label is {labels.max()}, expected 0 to 9"
    return None


def save_strokes(path: Path, splits: Mapping[str, StrokeArrays]) -> None:
    """Write a stroke file atomically. Its bytes depend only on the arrays."""
    check_strokes(splits, path, "Nothing was written")
    arrays = {f"{split}_{name}": array for split, arrays in splits.items() for name, array in arrays._asdict().items()}
    replace_file(path, npz_bytes(arrays))


def sha256_of_arrays(splits: Mapping[str, StrokeArrays]) -> dict[str, str]:
    """Hash the bytes of each array, without header or compression: `{"train_points": "21c5…", …}`."""
    return {
        f"{split}_{name}": hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        for split, arrays in splits.items()
        for name, array in arrays._asdict().items()
    }
