import numpy as np
import pytest
import torch

from forbes.data.strokes.dejong import dejong_path
from forbes.data.strokes.file import save_strokes
from forbes.data.strokes.source import Strokes
from forbes.errors import ForbesError

CORNER = [[(3, 4), (4, 4), (5, 4), (5, 5), (5, 6)]]
RETRACED = [[(1, 1), (2, 2), (3, 3)], [(3, 1), (2, 2), (1, 3)]]
DOT = [[(0, 27)]]


@pytest.fixture
def source(make_arrays, tmp_path):
    """Make a source of three training, one validation and two test digits."""
    save_strokes(
        tmp_path / "strokes.npz",
        {"train": make_arrays(CORNER, RETRACED, DOT, CORNER), "test": make_arrays(DOT, RETRACED)},
    )

    def make(**options):
        return Strokes(path=str(tmp_path / "strokes.npz"), **{"validation": 1, "frames": "whole", **options})

    return make


def render_slowly(points, length, points_per_step):
    """The definition: frame t, counted from 1, shows the first t * points_per_step points."""
    frames = np.zeros((length, 1, 28, 28), np.uint8)
    for t in range(1, length + 1):
        for x, y in points[: t * points_per_step]:
            frames[t - 1, 0, y, x] = 1
    return frames


@pytest.mark.parametrize("length", [1, 4, 9])
@pytest.mark.parametrize("points_per_step", [1, 2, 3])
def test_frames_are_what_a_slow_reference_renders(source, length, points_per_step):
    strokes = source(points_per_step=points_per_step)
    paths = [[pixel for stroke in digit for pixel in stroke] for digit in (CORNER, RETRACED, DOT)]

    batch = strokes.decode(strokes.gather("train", torch.tensor([0, 1, 2]), length))

    assert batch.observation.dtype == torch.uint8
    for path, frames in zip(paths, batch.observation, strict=True):
        np.testing.assert_array_equal(frames, render_slowly(path, length, points_per_step))


def test_bundled_digit_frames_match_a_slow_reference():
    strokes = Strokes(frames="whole")
    arrays = strokes.arrays("validation")
    index = torch.arange(0, 5000, 500)

    batch = strokes.decode(strokes.gather("validation", index, 30))

    for digit, frames in zip(index.tolist(), batch.observation, strict=True):
        path = arrays.points[arrays.offsets[digit] : arrays.offsets[digit + 1]]
        np.testing.assert_array_equal(frames, render_slowly(path, 30, 1))


@pytest.mark.parametrize("points_per_step", [1, 2, 3])
def test_written_and_whole_frames_determine_each_other(source, points_per_step):
    whole, written = (source(frames=frames, points_per_step=points_per_step) for frames in ("whole", "written"))
    index = torch.tensor([0, 1, 2])

    shown, added = (each.decode(each.gather("train", index, 9)) for each in (whole, written))

    before = torch.cat((torch.zeros_like(shown.observation[:, :1]), shown.observation[:, :-1]), 1)
    assert torch.equal(added.observation, shown.observation - before)
    assert torch.equal(written.pictures(added.observation), shown.observation)
    assert torch.equal(whole.pictures(shown.observation), shown.observation)
    assert torch.equal(added.mask, shown.mask)


def test_a_step_of_one_point_writes_at_most_one_pixel():
    strokes = Strokes()

    written = strokes.decode(strokes.gather("test", torch.arange(200), 30))
    pixels = written.observation.flatten(2).sum(-1)  # (B, T)

    assert pixels.max() == 1
    assert not pixels[~written.mask].any()
    assert not pixels[written.mask].all()  # where the pen crosses its own path it adds nothing


def test_pictures_of_probabilities_have_independent_pixels():
    chance = torch.rand(2, 3, 1, 4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    pictures = Strokes(frames="written").pictures(chance)

    for t in range(3):
        nobody = torch.stack([1 - chance[:, u] for u in range(t + 1)]).prod(0)
        torch.testing.assert_close(pictures[:, t], 1 - nobody)


@pytest.mark.parametrize(("points_per_step", "steps"), [(1, [5, 6, 1]), (2, [3, 3, 1]), (4, [2, 2, 1]), (9, [1, 1, 1])])
def test_the_mask_is_true_until_a_digit_is_whole(source, points_per_step, steps):
    strokes = source(points_per_step=points_per_step)

    batch = strokes.decode(strokes.gather("train", torch.tensor([0, 1, 2]), 8))

    expected = torch.arange(1, 9) <= torch.tensor(steps)[:, None]
    assert torch.equal(batch.mask, expected)
    assert strokes.steps("train")[:3].tolist() == steps


@pytest.mark.parametrize("frames", ["written", "whole"])
def test_an_observed_end_counts_the_steps_after_it(source, frames):
    masked, observed = source(frames=frames), source(frames=frames, end="observed")

    ended, going = (each.decode(each.gather("train", torch.tensor([0, 1, 2]), 8)) for each in (masked, observed))

    assert not ended.mask.all()
    assert going.mask.all()
    assert torch.equal(going.observation, ended.observation)
    assert torch.equal(observed.steps("train"), masked.steps("train"))


def test_a_cut_digit_is_the_beginning_of_the_whole_one(source):
    strokes = source(points_per_step=2)
    index = torch.tensor([1, 0])

    cut = strokes.decode(strokes.gather("train", index, 2))
    whole = strokes.decode(strokes.gather("train", index, 7))

    assert torch.equal(cut.observation, whole.observation[:, :2])
    assert torch.equal(cut.mask, whole.mask[:, :2])


def test_padding_shows_the_whole_digit(source):
    strokes = source()

    frames = strokes.decode(strokes.gather("train", torch.tensor([0]), 10)).observation[0]

    assert all(torch.equal(frame, frames[4]) for frame in frames[5:])


def test_a_digit_is_the_same_alone_and_in_a_batch(source):
    strokes = source()

    batch = strokes.decode(strokes.gather("train", torch.tensor([0, 1, 2, 1]), 6))
    alone = strokes.decode(strokes.gather("train", torch.tensor([1]), 6))

    for together, single in zip(batch, alone, strict=True):
        assert torch.equal(together[1:2], single)
        assert torch.equal(together[3:4], single)


def test_there_are_no_actions_and_no_rewards(source):
    strokes = source()

    batch = strokes.decode(strokes.gather("train", torch.tensor([0, 1]), 6))

    assert strokes.action_dim == 0
    assert batch.action.shape == (2, 6, 0)
    assert torch.equal(batch.reward, torch.zeros(2, 6))
    assert batch.observation.shape == (2, 6, *strokes.observation_shape)


def test_the_last_training_digits_are_the_validation_split():
    all_of_them, parted = Strokes(validation=0), Strokes(validation=5000)

    assert [parted.size(split) for split in ("train", "validation", "test")] == [55_000, 5_000, 10_000]
    assert all_of_them.size("train") == 60_000
    assert torch.equal(all_of_them.labels("train"), torch.cat([parted.labels("train"), parted.labels("validation")]))
    index = torch.tensor([0, 17, 4999])
    for one, other in zip(
        parted.gather("validation", index, 80), all_of_them.gather("train", index + 55_000, 80), strict=True
    ):
        assert torch.equal(one, other)


def test_the_file_is_read_on_first_use_only(tmp_path):
    strokes = Strokes(path=str(tmp_path / "absent.npz"))

    with pytest.raises(ForbesError, match=r"absent\.npz: no such file\. Rebuild it with: forbes data build"):
        strokes.size("train")


def test_the_papers_set_is_looked_for_where_forbes_data_points(tmp_path, monkeypatch):
    monkeypatch.setenv("FORBES_DATA", str(tmp_path))

    with pytest.raises(ForbesError, match="forbes data fetch strokes --from PATH, or use the bundled origin") as error:
        Strokes("dejong").size("train")

    assert str(tmp_path / "dejong-strokes.npz") in str(error.value)


def test_the_users_cache_is_the_second_place(tmp_path, monkeypatch):
    monkeypatch.delenv("FORBES_DATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert dejong_path() == tmp_path / "forbes" / "dejong-strokes.npz"

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert dejong_path() == tmp_path / ".cache" / "forbes" / "dejong-strokes.npz"


def test_another_set_does_not_pass_for_the_papers(source):
    with pytest.raises(ForbesError, match=r'array "train_points" has sha256 .*, expected 21c5ff4f5ad5f7e1…'):
        source(origin="dejong").size("train")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"points_per_step": 0}, "points_per_step is 0, expected at least 1"),
        ({"validation": -1}, "validation is -1, expected at least 0"),
        ({"origin": "jong"}, "origin is 'jong', expected bundled or dejong"),
        ({"frames": "wrote"}, "frames is 'wrote', expected written or whole"),
        ({"end": "observe"}, "end is 'observe', expected masked or observed"),
    ],
)
def test_a_value_out_of_range_is_refused(options, message):
    with pytest.raises(ForbesError, match=message):
        Strokes(**options)


def test_a_validation_split_of_all_digits_is_refused(source):
    with pytest.raises(ForbesError, match="validation is 4, expected less than the 4 digits"):
        source(validation=4).size("train")


def test_length_0_is_refused(source):
    with pytest.raises(ForbesError, match="length is 0, expected at least 1"):
        source().gather("train", torch.tensor([0]), 0)
