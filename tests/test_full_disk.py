"""A disk or a quota that is full: the file that cannot be written is named, and what was there stays whole."""

import errno
import json
import os
import resource
import shutil
import subprocess
import sys
import warnings
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure
from small_agents import fit, forbes, write_config

from forbes.callbacks import collect
from forbes.commands.cli import main
from forbes.data.download import download
from forbes.data.episodes.episode import Episode
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.data.strokes.file import load_strokes, save_strokes
from forbes.errors import ForbesError
from forbes.evaluation.record import write_record
from forbes.evaluation.scoring import PartialScores
from forbes.figures.style import save_figure
from forbes.files import append_whole, locked, replace_file
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import read_metrics
from forbes.runs.metrics_log import JsonLinesLogger
from forbes.runs.saving import AtomicCheckpointIO

LIMIT = 4000  # bytes of a file: more than an episode below, less than the index of ten
ENVIRONMENT = {"task": "Counting", "observation_shape": [2], "action_dim": 1, "discrete": False}


@contextmanager
def small_files(limit=LIMIT):
    """Let no process of ours write more bytes to a file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def append_episodes(folder, count=20, steps=5):
    with EpisodeWriter(folder) as writer:
        for _ in range(count):
            time = np.arange(steps + 1, dtype=np.float32)
            whole = Episode(np.stack([time, time], 1), time[:, None] / 100, time, terminated=False, frames=steps)
            writer.append(whole, seed=1, policy="test", environment=ENVIRONMENT)


def log_metrics(folder):
    folder.mkdir(exist_ok=True)
    logger = JsonLinesLogger(folder / "metrics.jsonl")
    for update in range(300):
        logger.log_metrics({"train/elbo": -1.5}, update)


def save_all_strokes(folder, strokes_file):
    splits = {split: arrays for split, arrays in load_strokes(strokes_file, "").items()}
    many = splits["train"]
    while len(many.points) < 4 * LIMIT:
        ends = many.offsets[1:] + len(many.points)
        points = np.concatenate([many.points, np.random.default_rng(len(many.points)).permuted(many.points)])
        joined = [np.concatenate([values, values]) for values in (many.pen_up, many.labels)]
        many = many._replace(points=points, pen_up=joined[0], offsets=np.append(many.offsets, ends), labels=joined[1])
    save_strokes(folder / "strokes.npz", splits | {"train": many})


def plot(folder, save, name):
    figure = Figure()
    figure.subplots().plot(np.random.default_rng(0).normal(size=2000))
    save(figure, folder / name)


MANY = torch.randn(1000, dtype=torch.float64)
WRITERS = {
    "report": lambda folder, _: replace_file(folder / "report", bytes(LIMIT + 1)),
    "last.ckpt": lambda folder, _: AtomicCheckpointIO().save_checkpoint({"weight": MANY}, folder / "last.ckpt"),
    "metrics.jsonl": lambda folder, _: log_metrics(folder),
    "000000.npz": lambda folder, _: append_episodes(folder, steps=1000),
    "index.jsonl": lambda folder, _: append_episodes(folder),
    "evaluation.npz": lambda folder, _: write_record(folder, {"elbo": {"mean": 1.0}}, {"elbo": MANY}),
    "0.npz": lambda folder, _: PartialScores(folder, "key").write(0, {"elbo": MANY}),
    "figure.pdf": lambda folder, _: plot(folder, save_figure, "figure.pdf"),
    "strokes.npz": save_all_strokes,
}


def left_whole(folder):
    """Check that nothing is half written, and list the names that are there."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(".lock")]
    for path in files:
        assert not path.name.startswith(".")
        if path.suffix == ".jsonl":
            assert path.read_text().endswith("}\n")
            assert all(map(json.loads, path.read_text().splitlines()))
    return {path.name for path in files}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_grows_too_large_is_named_with_a_remedy(name, tmp_path, strokes_file):
    with (
        small_files(),
        pytest.raises(ForbesError, match=rf"/{name}: cannot be written \(File too large\)\. Allow larger files \("),
    ):
        WRITERS[name](tmp_path / "folder", strokes_file)

    appended = {"metrics.jsonl", "index.jsonl"}
    assert left_whole(tmp_path / "folder") >= {name} & appended
    if name not in appended:
        assert left_whole(tmp_path / "folder") == set()


def test_a_download_that_grows_too_large_resumes_later(tmp_path):
    content = os.urandom(3 * 2**16)
    (tmp_path / "served").write_bytes(content)
    url, path = (tmp_path / "served").as_uri(), tmp_path / "fetched"

    with small_files(2**17), pytest.raises(ForbesError, match=r"/fetched\.part: cannot be written \(File too large\)"):
        download(url, path, "Try again")
    assert (tmp_path / "fetched.part").read_bytes() == content[: 2**17]

    download(url, path, "Try again")
    assert path.read_bytes() == content


def test_a_full_index_keeps_whole_episodes_and_grows_later(tmp_path):
    with small_files(), pytest.raises(ForbesError):
        append_episodes(tmp_path)
    stored = EpisodeStore(tmp_path)
    assert len(stored.records) > 5
    assert stored.files() == list(stored.records)

    append_episodes(tmp_path, 1)
    assert len(EpisodeStore(tmp_path).records) == len(stored.records) + 1


REMEDIES = {
    errno.ENOSPC: "Free some space, or",
    errno.EDQUOT: "Free some space in your quota",
    errno.EFBIG: "Allow larger files",
}


@pytest.mark.parametrize("number", REMEDIES)
@pytest.mark.parametrize("write", [replace_file, lambda path, content: append_whole(path, content, sync=True)])
def test_each_kind_of_full_has_a_remedy_and_changes_no_file(number, write, tmp_path, monkeypatch):
    (tmp_path / "report").write_bytes(b"old")

    def full(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ForbesError, match=rf"report: cannot be written \({os.strerror(number)}\)\. {REMEDIES[number]}"):
        write(tmp_path / "report", b"new")

    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    assert (tmp_path / "report").read_bytes() == b"old"


def test_a_full_disk_that_another_library_meets_is_one_sentence(monkeypatch, capsys):
    for name, said in (("there", "there: cannot be written"), (None, "the output: cannot be written")):

        def full(arguments, name=name):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *([name] if name else []))

        monkeypatch.setattr("forbes.commands.doctor.main", full)
        assert main(["doctor"]) == 2
        assert (
            capsys.readouterr().err
            == f"forbes: {said} (No space left on device). Free some space, or choose another folder\n"
        )


@pytest.mark.parametrize("when", range(2, 9))
def test_training_on_a_full_disk_names_the_file_and_can_resume(
    tiny_config, tiny_run, tmp_path, monkeypatch, capsys, when
):
    """The disk is full from the n-th file on, also for what is written because the training has failed."""
    calls, sync = [], os.fsync

    def fsync(descriptor):
        calls.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        if len(calls) >= when:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run")]) == 2

    *_, said = capsys.readouterr().err.splitlines()
    assert said.startswith(f"forbes: {tmp_path / 'run'}/")
    assert said.endswith("cannot be written (No space left on device). Free some space, or choose another folder")
    first = calls[when - 1]
    name = os.path.basename(first).removeprefix(".").rpartition(".")[0] if "." in os.path.basename(first) else ""
    assert name in said
    resumed = (tmp_path / "run" / "checkpoints" / "last.ckpt").exists()
    again = ["--resume", str(tmp_path / "run")] if resumed else ["--config", str(tiny_config), "--run_dir"]
    assert main(["fit", *again, *([] if resumed else [str(tmp_path / "run")])]) == 0
    pd.testing.assert_frame_equal(read_metrics(tmp_path / "run"), read_metrics(tiny_run), check_exact=True)


ON_A_FULL_DISK = """
import json, sys
from pathlib import Path
from test_full_disk import append_episodes, left_whole, log_metrics
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.saving import AtomicCheckpointIO

disk, said = Path(sys.argv[1]), []
AtomicCheckpointIO().save_checkpoint({"number": 0}, disk / "last.ckpt")
large = {"number": 1, "noise": list(range(10**5))}
for fill in (
    lambda: append_episodes(disk / "store", 10**6),
    lambda: [log_metrics(disk) for _ in range(10**4)],
    lambda: AtomicCheckpointIO().save_checkpoint(large, disk / "last.ckpt"),
):
    try:
        fill()
    except ForbesError as error:
        said.append(str(error))
left_whole(disk)
store = EpisodeStore(disk / "store")
assert store.files() == list(store.records)
assert read_checkpoint(disk / "last.ckpt") == {"number": 0}
with EpisodeWriter(disk / "store") as writer:
    (disk / "metrics.jsonl").unlink()
    writer.forget(len(store.records) - 1)
append_episodes(disk / "store", 1)
print(json.dumps(said))
"""


def test_a_disk_that_is_really_full_loses_nothing_and_is_named(tmp_path):
    inside = f"mount -t tmpfs -o size=300k none {tmp_path}"
    private = ["unshare", "--mount", "--map-root-user", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*private, inside], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")

    command = f'{inside} && exec "$0" -c "$1" {tmp_path}'
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([os.path.dirname(__file__), *sys.path])}
    done = subprocess.run(
        [*private, command, sys.executable, ON_A_FULL_DISK], capture_output=True, text=True, env=environment
    )

    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert len(said) == 3
    assert all(
        "cannot be written (No space left on device). Free some space, or choose another folder" in each
        for each in said
    )
    assert [part in each for part, each in zip(("/store/", "/metrics.jsonl", "/last.ckpt"), said, strict=True)] == [
        True
    ] * 3


def test_a_lock_that_cannot_be_written_is_named(tmp_path):
    with small_files(0), pytest.raises(ForbesError, match=r"\.lock: cannot be written \(File too large\)"):
        with locked(tmp_path, "works here"):
            pass


@contextmanager
def free(monkeypatch, count):
    """Let every disk have so many bytes left."""
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=count))
        yield


def weights_of(run):
    state = read_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    return sum(values.nbytes for values in state.values())


@pytest.mark.parametrize(("share", "said"), [(0.9, "refused"), (1.1, "warned"), (11.9, "warned"), (12.1, "fits")])
def test_checkpoints_that_will_not_fit_are_reported_beforehand(
    share, said, tiny_config, tiny_run, tmp_path, monkeypatch, capsys
):
    """Four files, of the weights and two moments for each of them: refused where not even the weights fit."""
    command = ["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run"), "--trainer.max_epochs", "1"]
    with free(monkeypatch, share * weights_of(tiny_run)), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert main(command) == (2 if said == "refused" else 0)

    told = [str(each.message) for each in caught if "checkpoints will take about" in str(each.message)]
    assert len(told) == (said == "warned")
    assert ("checkpoints take at least" in capsys.readouterr().err) == (said == "refused")
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").exists() == (said != "refused")


def test_a_checkpoint_has_the_weights_and_two_moments(tiny_run):
    """What the estimate counts; names and counters, which it leaves out, are small beside those of a real model."""
    (optimizer,) = read_checkpoint(tiny_run / "checkpoints" / "last.ckpt")["optimizer_states"]
    tensors = [value for state in optimizer["state"].values() for value in state.values() if value.ndim]

    assert sum(value.nbytes for value in tensors) == 2 * weights_of(tiny_run)


@pytest.mark.parametrize(("count", "warns"), [(17, False), (22, True)])
def test_collecting_more_than_fits_warns_after_one_episode(count, warns, tmp_path, monkeypatch):
    command = ["data", "collect", "--task", "Parrot", "-o", str(tmp_path / "store"), "--episodes"]
    assert forbes(*command, 1) == 0
    size = EpisodeStore(tmp_path / "store").records[0].size
    with free(monkeypatch, 16.5 * size), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert forbes(*command, count) == 0
    assert any("the remaining episodes will take about" in str(each.message) for each in caught) == warns


@pytest.mark.parametrize(("capacity", "more"), [(1000, 2), (24, 1), (16, 0)])
def test_first_episodes_predict_the_space_an_agent_needs(capacity, more, tmp_path, monkeypatch):
    """Two of 8 steps are followed by two more; a capacity of 24 steps has room for one of them, 16 for none."""
    foreseen = []
    monkeypatch.setattr(collect, "require_room", lambda folder, what, likely: foreseen.append((folder, likely)))
    run = tmp_path / "run"
    assert fit("--config", write_config(tmp_path), "--data.source.capacity", capacity, "--run_dir", run) == 0

    ((folder, likely),) = foreseen
    assert folder == run
    assert likely == pytest.approx(more * EpisodeStore(run / "episodes").records[0].size, rel=0.02)
