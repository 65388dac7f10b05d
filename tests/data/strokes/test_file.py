import hashlib
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forbes.data.strokes.file import load_strokes, save_strokes
from forbes.data.strokes.source import bundled_path
from forbes.errors import ForbesError

pixels = st.tuples(st.integers(0, 27), st.integers(0, 27))
digits = st.lists(st.lists(st.lists(pixels, min_size=1), min_size=1), min_size=1)
LINE = [[(3, 4), (4, 4), (5, 4)]]


@pytest.fixture
def splits(make_arrays):
    return {"train": make_arrays(LINE, [[(0, 0)], [(27, 27)]]), "test": make_arrays(LINE)}


@settings(max_examples=30)
@given(train=digits, test=digits)
def test_loading_gives_what_was_saved(make_arrays, tmp_path_factory, train, test):
    path = tmp_path_factory.mktemp("strokes") / "strokes.npz"
    splits = {"train": make_arrays(*train), "test": make_arrays(*test)}

    save_strokes(path, splits)
    loaded = load_strokes(path, "")

    for split, arrays in splits.items():
        for saved, found in zip(arrays, loaded[split], strict=True):
            assert saved.dtype == found.dtype
            np.testing.assert_array_equal(saved, found)


def test_the_bytes_depend_on_the_arrays_alone(splits, tmp_path, monkeypatch):
    save_strokes(tmp_path / "one.npz", splits)
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    save_strokes(tmp_path / "other.npz", splits)

    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "other.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.npz") as archive:
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_numpy_reads_the_file(splits, tmp_path):
    save_strokes(tmp_path / "strokes.npz", splits)

    with np.load(tmp_path / "strokes.npz") as file:
        np.testing.assert_array_equal(file["train_points"], splits["train"].points)


def test_saving_leaves_nothing_else_behind(splits, tmp_path):
    save_strokes(tmp_path / "strokes.npz", splits)

    assert [path.name for path in tmp_path.iterdir()] == ["strokes.npz"]


def test_the_bundled_set_is_small_and_matches_its_readme():
    content = bundled_path().read_bytes()

    assert len(content) <= 3_000_000
    assert hashlib.sha256(content).hexdigest() in bundled_path().with_name("README.md").read_text("utf-8")


def test_a_missing_file_is_named_with_the_remedy(tmp_path):
    with pytest.raises(ForbesError, match=r"absent\.npz: no such file\. Do this\."):
        load_strokes(tmp_path / "absent.npz", "Do this.")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.99])
def test_a_truncated_file_is_refused(tmp_path, share):
    content = bundled_path().read_bytes()
    (tmp_path / "strokes.npz").write_bytes(content[: int(share * len(content))])

    with pytest.raises(ForbesError, match=r"truncated or not a stroke file .* Do this\."):
        load_strokes(tmp_path / "strokes.npz", "Do this.")


def test_a_damaged_file_is_refused(splits, tmp_path):
    save_strokes(tmp_path / "strokes.npz", splits)
    content = bytearray((tmp_path / "strokes.npz").read_bytes())
    content[content.index(b"train_points.npy") + 30] ^= 0xFF
    (tmp_path / "strokes.npz").write_bytes(content)

    with pytest.raises(ForbesError, match="truncated or not a stroke file"):
        load_strokes(tmp_path / "strokes.npz", "Do this.")


def test_an_array_that_would_fill_the_memory_is_refused(splits, tmp_path, monkeypatch):
    save_strokes(tmp_path / "strokes.npz", splits)
    monkeypatch.setattr("forbes.data.strokes.file._MEMBER_LIMIT", 130)

    with pytest.raises(ForbesError, match=r'array "train_points" has \d+ bytes, expected at most 130'):
        load_strokes(tmp_path / "strokes.npz", "Do this.")


def write(path, splits, **changed):
    arrays = {f"{split}_{name}": array for split, set_ in splits.items() for name, array in set_._asdict().items()}
    np.savez_compressed(path, **{name: array for name, array in (arrays | changed).items() if array is not None})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"test_points": None}, 'array "test_points" is missing'),
        ({"test_points": np.zeros((3, 2))}, 'array "test_points" has dtype float64, expected uint8'),
        ({"test_pen_up": np.ones(3, np.uint8)}, 'array "test_pen_up" has dtype uint8, expected bool'),
        ({"test_points": np.array([None, None])}, "truncated or not a stroke file"),
        ({"test_points": np.zeros(6, np.uint8)}, r'array "test_points" has shape \(6,\), expected \(points, 2\)'),
        ({"test_points": np.zeros((2, 3), np.uint8)}, r"has shape \(2, 3\), expected \(points, 2\)"),
        ({"test_labels": np.zeros((1, 1), np.uint8)}, r"has shape \(1, 1\), expected \(digits,\)"),
        ({"test_points": np.full((3, 2), 28, np.uint8)}, "split test, a point has coordinate 28, expected 0 to 27"),
        ({"train_offsets": np.array([0, 3, 3], np.int32)}, "offsets run from 0 to 3, expected 0 to 5"),
        ({"train_offsets": np.array([0, 5, 5], np.int32)}, "offsets do not increase at digit 1"),
        ({"train_offsets": np.array([0, 7, 5], np.int32)}, "offsets do not increase at digit 1"),
        ({"train_offsets": np.array([1, 3, 5], np.int32)}, "offsets run from 1 to 5"),
        ({"train_offsets": np.array([0, 5], np.int32)}, "offsets has 2 entries, expected one more than the 2 labels"),
        ({"train_offsets": np.array([], np.int32)}, "offsets has 0 entries"),
        ({"train_pen_up": np.ones(4, bool)}, "pen_up has 4 entries, expected one per point, 5"),
        ({"train_pen_up": np.zeros(5, bool)}, "a digit ends with the pen down"),
        ({"test_labels": np.array([10], np.uint8)}, "a label is 10, expected 0 to 9"),
    ],
)
def test_arrays_that_are_not_what_the_format_says_are_refused(splits, tmp_path, changed, message):
    write(tmp_path / "strokes.npz", splits, **changed)

    with pytest.raises(ForbesError, match=message) as error:
        load_strokes(tmp_path / "strokes.npz", "Do this.")

    assert str(error.value).startswith(f"{tmp_path / 'strokes.npz'}: ")
    assert str(error.value).endswith(". Do this.")


def test_a_file_that_loading_would_refuse_is_not_written(splits, tmp_path):
    splits["test"].points[0] = 28

    with pytest.raises(ForbesError, match="a point has coordinate 28"):
        save_strokes(tmp_path / "strokes.npz", splits)

    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named(splits, tmp_path):
    (tmp_path / "file").touch()

    with pytest.raises(ForbesError, match=r"strokes\.npz: cannot be written \(.*\)\. Choose another folder"):
        save_strokes(tmp_path / "file" / "strokes.npz", splits)
