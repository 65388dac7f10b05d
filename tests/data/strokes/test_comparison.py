import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from forbes.data.strokes.comparison import compare_digits, compare_sets
from forbes.data.strokes.dejong import dejong_path
from forbes.data.strokes.source import Strokes
from forbes.errors import ForbesError

pixels = st.tuples(st.integers(0, 27), st.integers(0, 27))
paths = st.lists(pixels, min_size=1, max_size=20).map(lambda path: np.array(path, np.uint8))


@given(paths)
def test_a_path_and_itself_backwards_have_everything_in_common(path):
    assume(len(np.unique(path, axis=0)) == len(path) > 2)

    for other in (path, path[::-1]):
        assert compare_digits(path, other) == pytest.approx((1, 0, 1))


@given(paths, paths)
def test_the_measures_are_their_definitions(one, other):
    a, b = set(map(tuple, one.tolist())), set(map(tuple, other.tolist()))
    there = np.mean([min(math.dist(p, q) for q in b) for p in a])
    back = np.mean([min(math.dist(p, q) for p in a) for q in b])

    iou, chamfer, _ = compare_digits(one, other)

    assert iou == pytest.approx(len(a & b) / len(a | b))
    assert chamfer == pytest.approx((there + back) / 2)


def test_order_is_spearmans_correlation_of_first_visits():
    one = np.array([(0, 0), (1, 0), (2, 0), (0, 0), (3, 0), (9, 9)], np.uint8)
    other = np.array([(1, 0), (0, 0), (5, 5), (2, 0), (3, 0)], np.uint8)

    # ranks of (0, 0), (1, 0), (2, 0), (3, 0): 1 2 3 4 and 2 1 3 4, so Σ d² = 2 and ρ = 1 − 6 · 2 / (4 · 15)
    assert compare_digits(one, other).order == pytest.approx(0.8)
    assert math.isnan(compare_digits(one[:2], other).order)


def test_sets_of_different_digits_are_not_compared(make_arrays):
    one, other = make_arrays([[(1, 1)]]), make_arrays([[(1, 1)]], [[(1, 1)]])

    with pytest.raises(ForbesError, match="different labels, expected the same digits"):
        compare_sets(one, other)


@pytest.mark.skipif(not dejong_path().is_file(), reason="the paper's set is not here: forbes data fetch strokes")
def test_the_bundled_digits_are_close_to_the_papers():
    measures = compare_sets(Strokes().arrays("test"), Strokes("dejong").arrays("test"))

    assert measures["pixel IoU, mean"][0] >= 0.65
    assert measures["Chamfer distance in pixels, mean"][0] <= 0.25
    assert measures["order correlation, mean"][0] >= 0.8
    ours, theirs = measures["points per digit, median"]
    assert abs(ours / theirs - 1) <= 0.1
