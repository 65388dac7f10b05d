"""What is written to a folder is written there, whatever somebody has put into it."""

import os
import re
import shutil
from pathlib import Path

import pytest

from forbes.commands.cli import main
from forbes.data.episodes.store import EpisodeWriter
from forbes.errors import ForbesError
from forbes.files import locked, no_link, replace_file
from forbes.runs.metrics_log import JsonLinesLogger
from forbes.runs.saving import AtomicCheckpointIO

PRECIOUS = "precious, and without an end of line"


@pytest.fixture
def precious(tmp_path):
    """A file outside the folder, which the links name."""
    path = tmp_path / "precious"
    path.write_text(PRECIOUS)
    return path


@pytest.fixture
def run(tiny_run, tmp_path):
    return shutil.copytree(tiny_run, tmp_path / "run")


def link(path, target):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.symlink_to(target)


@pytest.mark.parametrize("name", [".lock", "metrics.jsonl", "checkpoints/.last.ckpt.part", "config.yaml"])
def test_a_run_with_a_link_is_not_resumed(run, precious, capsys, name):
    content = (run / name).read_bytes() if (run / name).is_file() else PRECIOUS.encode()
    precious.write_bytes(content)
    link(run / name, precious)

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 2

    assert f"{run / name}: is a symbolic link, expected a file or folder" in capsys.readouterr().err
    assert precious.read_bytes() == content


@pytest.mark.parametrize("name", ["figures", "evaluation-parts", "checkpoints"])
def test_nothing_is_written_through_a_linked_folder(run, tmp_path, capsys, name):
    outside = tmp_path / "outside"
    (run / name).rename(outside) if (run / name).is_dir() else outside.mkdir()
    before = {path.name: path.read_bytes() for path in outside.iterdir()}
    (run / name).symlink_to(outside)

    assert main(["evaluate", str(run), "--scores", "elbo"]) == 2

    assert f"{run / name}: is a symbolic link" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in outside.iterdir()} == before


def test_a_linked_report_is_replaced_not_followed(run, tmp_path):
    for name in ("evaluation.json", "evaluation.npz"):
        link(run / name, tmp_path / "elsewhere")

    assert main(["evaluate", str(run), "--scores", "elbo"]) == 0

    assert not (tmp_path / "elsewhere").exists()
    assert not (run / "evaluation.json").is_symlink()


def test_a_replaced_link_leaves_what_it_named(tmp_path, precious):
    link(tmp_path / "report", precious)

    replace_file(tmp_path / "report", b"new")

    assert precious.read_text() == PRECIOUS
    assert not (tmp_path / "report").is_symlink()
    assert (tmp_path / "report").read_text() == "new"


def test_links_at_guessable_names_are_not_followed(tmp_path, precious):
    folder = tmp_path / "folder"
    for name in (".report.part", f".report.{os.getpid()}", "report.part"):
        link(folder / name, precious)

    replace_file(folder / "report", b"new")
    AtomicCheckpointIO().save_checkpoint({"step": 1}, folder / "report")

    assert precious.read_text() == PRECIOUS


def test_a_new_file_is_made_as_the_umask_says(tmp_path):
    before = os.umask(0o027)
    try:
        replace_file(tmp_path / "report", b"new")
    finally:
        os.umask(before)

    assert (tmp_path / "report").stat().st_mode & 0o777 == 0o640


def test_a_file_that_is_refused_replaces_nothing(tmp_path, precious):
    def refuse(path):
        raise ForbesError(f"{path}: no")

    with pytest.raises(ForbesError, match="no"):
        replace_file(precious, b"new", refuse)

    assert precious.read_text() == PRECIOUS
    assert [path.name for path in tmp_path.iterdir()] == ["precious"]


def test_metrics_are_not_appended_through_a_link(tmp_path, precious):
    link(tmp_path / "metrics.jsonl", precious)

    with pytest.raises(ForbesError, match=r"metrics\.jsonl: is a symbolic link"):
        JsonLinesLogger(tmp_path / "metrics.jsonl").mark_start(0)

    assert precious.read_text() == PRECIOUS


@pytest.mark.parametrize("name", [".lock", "index.jsonl", "000000.npz", "set_aside", "quarantine"])
def test_a_store_with_a_link_is_not_written_to(tmp_path, precious, name):
    link(tmp_path / "store" / name, precious)

    with pytest.raises(ForbesError, match=f"{name}: is a symbolic link"), EpisodeWriter(tmp_path / "store"):
        pass

    assert precious.read_text() == PRECIOUS


def test_a_folder_may_be_reached_by_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "disk")

    with locked(tmp_path / "runs" / "one", "works here"):
        replace_file(tmp_path / "runs" / "one" / "report", b"new")

    assert (tmp_path / "disk" / "one" / "report").read_bytes() == b"new"


def test_every_file_that_is_appended_to_is_opened_without_links():
    """The rest is written by `replace_file`, whose names are new."""
    sources = Path(__file__).parents[1].joinpath("forbes").rglob("*.py")
    lines = [line for path in sources for line in path.read_text().splitlines()]

    opened = [line for line in lines if "open(" in line and "av.open(" not in line]  # a video is made in memory
    appending = [line for line in opened if re.search(r'[(, ]"([aw]b?\+?|rb?\+b?)"', line)]

    assert len(appending) >= 4
    assert [line for line in appending if no_link.__name__ not in line] == []
