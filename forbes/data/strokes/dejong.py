"""The paper's stroke set by Edwin D. de Jong: its path, hashes and row format."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forbes.data.download import data_folder
from forbes.data.strokes.file import SIDE, StrokeArrays, sha256_of_arrays
from forbes.errors import ForbesError

__all__ = ["DEJONG_SHA256", "dejong_path", "parse_digit", "verify_dejong"]

DEJONG_SHA256 = {
    "train_points": "21c5ff4f5ad5f7e13cf414c8daea5e4dee7515b2a6dc1adf1fc297e7eeba7344",
    "train_pen_up": "b84b5c99597c721c8a549e83b1edd6261b2b8c40e36414e1c3f5fa3ce9cf963d",
    "train_offsets": "dc3a656d69f73553507ca2f969d6e796fdb71796cb05f68c09205593f1fe0c30",
    "train_labels": "1feba77c54802fa5339a11837ea4b2866434b83314ec45192930f1df69120c13",
    "test_points": "fffbe792bf37d24a264778fa86217be9629067cb56f74269f8362860863400d1",
    "test_pen_up": "4524f808fb95509fa796a0a8d002ad3e706704a8b42b790bf2a8059d803ae598",
    "test_offsets": "6957fdd21eff2fa0b126596f2d42cb5799039e8177f82d8a4723890dd34553f4",
    "test_labels": "ddeff807876a9661a1110d45c266c86239a3a1b7d37da0c3716a7a683c852ff5",
}
"""SHA-256 of each array after conversion of all 60,000 training and 10,000 test digits."""


def dejong_path() -> Path:
    """Return the path of the paper's set."""
    return data_folder() / "dejong-strokes.npz"


def verify_dejong(splits: Mapping[str, StrokeArrays], where: Path, remedy: str) -> None:
    """Raise a `ForbesError` unless every array has the hash of the paper's set."""
    for name, found in sha256_of_arrays(splits).items():
        if found != DEJONG_SHA256[name]:
            expected = DEJONG_SHA256[name]
            raise ForbesError(
                f'{where}: array "{name}" has sha256 {found[:16]}…, expected {expected[:16]}…, the paper\'s. {remedy}'
            )


def parse_digit(text: bytes, where: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Convert the rows `dx dy eos eod` of a digit.

    The first row is the first point, with coordinates from 1. Every other row is a move from the previous point. A row
    with eos = 1 lifts the pen and is not a point. The last row has eod = 1::

        5 9 0 0     the point (4, 8)
        0 1 0 0     the point (4, 9), where the stroke ends
        0 0 1 1

    Args:
        text: rows of the digit.
        where: name of the digit for error messages.

    Returns:
        Points (x, y), uint8 (P, 2), and whether the pen is lifted after each point, bool (P,).
    """
    try:
        rows = np.array([line.split() for line in text.splitlines()], dtype=np.int16)
    except (ValueError, OverflowError) as error:
        raise ForbesError(f"{where}: a row is not four small integers ({error}), expected dx dy eos eod.") from error
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise ForbesError(f"{where}: rows have shape {rows.shape}, expected (rows, 4): dx dy eos eod.")
    moves, lift, last = rows[:, :2], rows[:, 2] == 1, rows[:, 3] == 1
    if not np.isin(rows[:, 2:], (0, 1)).all() or lift[0] or moves[lift].any():
        raise ForbesError(f"{where}: a flag is neither 0 nor 1, or a pen lift moves, expected rows like 0 0 1 0.")
    if not last[-1] or last[:-1].any():
        raise ForbesError(f"{where}: eod is not 1 at the last row and nowhere else, expected a whole digit.")
    path = moves.cumsum(axis=0)[~lift] - 1  # (P, 2)
    if path.min() < 0 or path.max() >= SIDE:
        raise ForbesError(f"{where}: a point lies outside the image, expected coordinates 1 to {SIDE}.")
    pen_up = np.append(lift[1:], True)[~lift]  # (P,)
    pen_up[-1] = True
    return path.astype(np.uint8), pen_up
