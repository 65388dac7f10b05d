import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from forbes.data.strokes.dejong import DEJONG_SHA256, dejong_path, parse_digit, verify_dejong
from forbes.data.strokes.file import load_strokes
from forbes.errors import ForbesError

# Training digit 2 of Edwin D. de Jong's MNIST stroke sequence data set (CC BY-SA 3.0), a 4 of two strokes.
TRAIN_2 = b"""\
5 9 0 0\n0 1 0 0\n0 1 0 0\n0 1 0 0\n0 1 0 0\n-1 1 0 0\n0 1 0 0\n1 1 0 0\n1 0 0 0\n1 0 0 0\n1 0 0 0\n1 0 0 0\n1 0 0 0
1 0 0 0\n1 0 0 0\n1 0 0 0\n1 -1 0 0\n1 0 0 0\n1 0 0 0\n1 0 0 0\n1 0 0 0\n1 0 0 0\n0 1 0 0\n0 1 0 0\n0 1 0 0\n-1 1 0 0
0 1 0 0\n0 1 0 0\n0 1 0 0\n0 1 0 0\n0 0 1 0\n1 -9 0 0\n1 -1 0 0\n0 -1 0 0\n0 -1 0 0\n1 -1 0 0\n0 -1 0 0\n1 -1 0 0
0 -1 0 0\n0 -1 0 0\n0 0 1 1
"""


def test_a_real_digit_is_converted_to_its_pixels():
    points, pen_up = parse_digit(TRAIN_2, "digit")

    assert points.tolist()[:7] == [[4, 8], [4, 9], [4, 10], [4, 11], [4, 12], [3, 13], [3, 14]]
    assert points.tolist()[-3:] == [[21, 7], [21, 6], [21, 5]]
    assert (points.dtype, points.shape) == (np.uint8, (39, 2))
    assert np.flatnonzero(pen_up).tolist() == [29, 38]


pixels = st.tuples(st.integers(0, 27), st.integers(0, 27))


@given(st.lists(st.lists(pixels, min_size=1), min_size=1))
def test_a_digit_written_in_rows_is_read_back(strokes):
    rows, here = [], (-1, -1)
    for stroke in strokes:
        for x, y in stroke:
            rows.append(f"{x - here[0]} {y - here[1]} 0 0")
            here = (x, y)
        rows.append("0 0 1 0")
    rows[-1] = "0 0 1 1"

    points, pen_up = parse_digit("\n".join(rows).encode(), "digit")

    assert points.tolist() == [list(pixel) for stroke in strokes for pixel in stroke]
    assert np.flatnonzero(pen_up).tolist() == (np.cumsum([len(stroke) for stroke in strokes]) - 1).tolist()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (b"", r"rows have shape \(0,\)"),
        (b"5 9 0\n0 0 1\n", r"rows have shape \(2, 3\)"),
        (b"5 9 0 0\n0 0 1\n", "a row is not four small integers"),
        (b"5 9 0 0\nx 0 1 1\n", "a row is not four small integers"),
        (b"5 9 0 0\n99999 0 0 0\n0 0 1 1\n", "a row is not four small integers"),
        (b"5 9 0 0\n0 0 2 1\n", "a flag is neither 0 nor 1"),
        (b"0 0 1 0\n5 9 0 0\n0 0 1 1\n", "a pen lift moves"),
        (b"5 9 0 0\n1 0 1 1\n", "a pen lift moves"),
        (b"5 9 0 0\n0 0 1 0\n", "eod is not 1 at the last row"),
        (b"5 9 0 1\n0 0 1 1\n", "eod is not 1 at the last row and nowhere else"),
        (b"0 9 0 0\n0 0 1 1\n", "a point lies outside the image, expected coordinates 1 to 28"),
        (b"28 9 0 0\n1 0 0 0\n0 0 1 1\n", "a point lies outside the image"),
        (b"32767 9 0 0\n32767 0 0 0\n0 0 1 1\n", "a point lies outside the image"),
    ],
)
def test_rows_that_are_no_digit_are_refused(rows, message):
    with pytest.raises(ForbesError, match=message) as error:
        parse_digit(rows, "trainimg-7-inputdata.txt")

    assert str(error.value).startswith("trainimg-7-inputdata.txt: ")


def test_arrays_other_than_the_papers_are_refused(make_arrays, tmp_path):
    splits = {"train": make_arrays([[(1, 1)]])}

    with pytest.raises(ForbesError, match=r'file: array "train_points" has sha256 .* 21c5ff4f5ad5f7e1….*Do this\.'):
        verify_dejong(splits, tmp_path / "file", "Do this.")


@pytest.mark.skipif(not dejong_path().is_file(), reason="the paper's set is not here: forbes data fetch strokes")
def test_the_stored_set_is_the_papers():
    splits = load_strokes(dejong_path(), "Do this.")

    verify_dejong(splits, dejong_path(), "Do this.")

    points, pen_up = parse_digit(TRAIN_2, "digit")
    digit = slice(*splits["train"].offsets[2:4])
    np.testing.assert_array_equal(splits["train"].points[digit], points)
    np.testing.assert_array_equal(splits["train"].pen_up[digit], pen_up)
    assert len(DEJONG_SHA256) == 8
