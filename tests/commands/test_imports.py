"""`forbes data import` and `export`, as a user calls them."""

import sys

import numpy as np
import pytest
import recordings
from command_line import error_of

from forbes.commands.cli import main
from forbes.data.episodes.store import EpisodeStore


@pytest.fixture
def recorded(tmp_path):
    """A folder of three episodes of pictures."""
    return recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(3, images=True))


def test_a_dry_run_prints_the_table_and_writes_nothing(recorded, tmp_path, capsys):
    assert main(["data", "import", str(recorded), "-o", str(tmp_path / "store"), "--resize", "16", "--dry-run"]) == 0

    output = capsys.readouterr().out
    assert "image       │ observation │ (32, 32, 3) │ uint8" in output
    assert "observation uint8 (3, 16, 16)" in output
    assert "episodes    3, of 4 to 6 steps, 1 terminated" in output
    assert "index t has the action and reward that led to o_t, as in a store" in output
    assert [path.name for path in tmp_path.iterdir()] == ["recorded"]


def test_an_import_trains_and_is_exported(recorded, tmp_path, capsys):
    store, exported = tmp_path / "store", tmp_path / "exported"
    assert main(["data", "import", str(recorded), "-o", str(store)]) == 0
    assert f"{store}: 3 episodes imported, 15 agent steps" in capsys.readouterr().out
    assert main(["data", "import", str(recorded), "-o", str(store)]) == 0
    assert f"{store}: already imported, 3 episodes" in capsys.readouterr().out
    assert main(["data", "export", str(store), "--format", "npz", "-o", str(exported)]) == 0
    assert f"{exported}: 3 episodes exported, 15 agent steps" in capsys.readouterr().out
    assert main(["data", "info", str(store)]) == 0

    with np.load(exported / "000001-6.npz") as arrays:
        np.testing.assert_array_equal(arrays["image"].transpose(0, 3, 1, 2), EpisodeStore(store).episode(1).observation)
        assert arrays["is_terminal"].tolist() == [False] * 5 + [True]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ["--image", "picture"],
            "--image picture: no such key. There are action, image, is_first, is_terminal, reward",
        ),
        (["--proprio", "image", "--image", "image"], "--image image and --proprio image are the same key"),
        (["--action", "push"], "--action push: no such key"),
        (["--format", "arrays"], "truncated or not arrays"),
        (["--fps", "5"], "--fps 5 needs the rate of the data, which dreamer has not"),
        (["--fps", "0"], "0 is not a number of steps per second above 0"),
        (["--resize", "0"], "0 is not a number above 0"),
        (["--format", "zarr"], "invalid choice: 'zarr'"),
    ],
)
def test_a_wrong_option_is_one_sentence(options, sentence, recorded, tmp_path, capsys):
    assert sentence in error_of(capsys, "data", "import", recorded, "-o", tmp_path / "store", *options)
    assert not (tmp_path / "store").exists()


def test_several_observations_are_refused_with_their_keys(tmp_path, capsys):
    path = recordings.write("lerobot", tmp_path / "recorded", recordings.episodes(2))

    sentence = error_of(capsys, "data", "import", path, "-o", tmp_path / "store")

    assert (
        "Choose some of --image observation.images.top --proprio observation.state; each image becomes a part"
        in sentence
    )


@pytest.mark.parametrize(
    ("name", "library", "extra"),
    [
        ("robomimic", "h5py", "hdf5"),
        ("minari", "minari", "minari"),
        ("lerobot", "pyarrow.parquet", "lerobot"),
        ("mp4", "av", "video"),
        ("lance", "lance", "lance"),
    ],
)
def test_a_missing_library_is_named(name, library, extra, tmp_path, capsys, monkeypatch):
    path = recordings.write(name, tmp_path / "recorded", recordings.episodes(2, images=name == "mp4"))
    monkeypatch.setitem(sys.modules, library, None)

    sentence = error_of(capsys, "data", "import", path, "-o", tmp_path / "store")

    assert sentence == f"{library} is not installed, and this format needs it. pip install 'forbes[{extra}]'"
