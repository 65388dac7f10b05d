import hashlib

import numpy as np
import pytest
from PIL import Image

from forbes.commands.parsers.data import main
from forbes.data import download
from forbes.data.download import git_blob_id
from forbes.data.strokes.file import load_strokes, save_strokes
from forbes.data.strokes.source import bundled_path
from forbes.errors import ForbesError


@pytest.fixture
def images(mnist_digits, tmp_path):
    """A folder of IDX files with ten training and ten test digits."""
    pictures, labels = mnist_digits
    folder = tmp_path / "images"
    folder.mkdir()
    for prefix in ("train", "t10k"):
        header = np.array([0x803, *pictures.shape], ">u4").tobytes()
        (folder / f"{prefix}-images-idx3-ubyte").write_bytes(header + pictures.tobytes())
        (folder / f"{prefix}-labels-idx1-ubyte").write_bytes(np.array([0x801, 10], ">u4").tobytes() + labels.tobytes())
    return folder


def test_building_twice_gives_the_same_bytes(images, tmp_path, capsys):
    output = tmp_path / "strokes.npz"

    for change in ("new", "unchanged"):
        main(["build-strokes", "--images", str(images), "-o", str(output)])
        digest = hashlib.sha256(output.read_bytes()).hexdigest()
        assert f"sha256 {digest}, {change}" in capsys.readouterr().out

    assert load_strokes(output, "")["test"].labels.tolist() == [7, 2, 1, 0, 4, 1, 4, 9, 5, 9]


def test_show_draws_each_digit_as_a_row(tmp_path, capsys):
    main(["show", "strokes", "--index", "0", "3", "-o", str(tmp_path / "two.png")])
    main(["show", "strokes", "--index", "0", "-o", str(tmp_path / "one.png")])

    two, one = (np.asarray(Image.open(tmp_path / name)) for name in ("two.png", "one.png"))
    assert abs(two.shape[0] - 2 * one.shape[0]) <= 1  # in pixels
    assert len(np.unique(two.reshape(-1, two.shape[-1]), axis=0)) > 20  # the colours of the order
    assert capsys.readouterr().out.splitlines()[0] == str(tmp_path / "two.png")


@pytest.mark.parametrize("index", ["10000", "-1"])
def test_a_digit_outside_its_split_is_refused(tmp_path, index):
    with pytest.raises(ForbesError, match=f"{index} is not in the test split, expected 0 to 9999"):
        main(["show", "strokes", f"--index={index}", "-o", str(tmp_path / "strokes.png")])


def test_a_picture_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ForbesError, match=r"strokes\.xyz: is not the name of an image \(.*\)\. End it in \.png"):
        main(["show", "strokes", "-o", str(tmp_path / "strokes.xyz")])
    with pytest.raises(ForbesError, match=r"file/strokes\.png: cannot be written \(.*\)\. Choose another folder"):
        main(["show", "strokes", "-o", str(tmp_path / "file" / "strokes.png")])


def test_fetch_stores_where_forbes_data_points(make_arrays, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FORBES_DATA", str(tmp_path / "store"))
    splits = {split: make_arrays([[(1, 1)]]) for split in ("train", "test")}
    save_strokes(tmp_path / "converted.npz", splits)
    with pytest.raises(ForbesError, match=r'converted\.npz: array "train_points" has sha256'):
        main(["fetch", "strokes", "--from", str(tmp_path / "converted.npz")])

    monkeypatch.setattr("forbes.data.strokes.fetch.verify_dejong", lambda *_: None)
    main(["fetch", "strokes", "--from", str(tmp_path / "converted.npz")])

    assert load_strokes(tmp_path / "store" / "dejong-strokes.npz", "")["train"].points.tolist() == [[1, 1]]
    assert f"{tmp_path / 'store' / 'dejong-strokes.npz'}: stored" in capsys.readouterr().out


def test_fetched_curves_are_stored_there_too(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FORBES_DATA", str(tmp_path / "store"))
    (tmp_path / "copy.json").write_text("[]")
    found = download.Curves("some-curves.json", "http://127.0.0.1:1", git_blob_id(tmp_path / "copy.json"))
    monkeypatch.setattr(download, "CURVES", (found,))

    main(["fetch", "curves", "--from", str(tmp_path / "copy.json")])

    stored = tmp_path / "store" / "some-curves.json"
    assert stored.read_text() == "[]"
    assert f"{stored}: stored" in capsys.readouterr().out
    main(["fetch", "curves"])  # nothing is downloaded again
    assert f"{stored}: already stored and verified" in capsys.readouterr().out


def test_fetch_rejects_a_stored_file_that_is_not_the_papers(make_arrays, tmp_path, monkeypatch):
    monkeypatch.setenv("FORBES_DATA", str(tmp_path))
    save_strokes(tmp_path / "dejong-strokes.npz", {split: make_arrays([[(1, 1)]]) for split in ("train", "test")})

    with pytest.raises(ForbesError, match=r'dejong-strokes\.npz: array "train_points" has sha256 .* Delete it'):
        main(["fetch", "strokes"])


def test_a_set_compared_with_itself_is_the_same(capsys, make_arrays, tmp_path):
    path = tmp_path / "strokes.npz"
    save_strokes(path, {split: make_arrays([[(1, 1), (1, 2), (1, 3)]]) for split in ("train", "test")})

    main(["compare-strokes", str(path), str(path)])

    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines[:3]] == ["1.000", "0.000", "1.000"]
    assert lines[-1].split()[-3:] == ["1.000", "/", "1.000"]


COMMANDS = ["build-strokes", "build-classifiers", "fetch", "compare-strokes", "show", "collect", "info", "check"]
COMMANDS += ["import", "export"]


def test_help_has_an_example_of_every_command(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])

    examples = capsys.readouterr().out.partition("examples:")[2]
    assert [line.split()[2] for line in examples.splitlines() if line] == COMMANDS


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_ends_with_an_example(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])

    assert f"example: forbes data {command} " in " ".join(capsys.readouterr().out.split())


def test_the_bundled_set_lies_beside_its_readme():
    assert bundled_path().with_name("README.md").is_file()
