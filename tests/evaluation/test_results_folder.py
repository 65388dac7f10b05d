"""Where the results of an evaluation go: into the run, beside those of its last checkpoint, or elsewhere."""

import json
import os
import shutil
import threading
import time

import pytest
import torch

from forbes.commands.cli import main
from forbes.evaluation import record
from forbes.evaluation.record import read_record, write_record

QUICK = ["--scores", "elbo", "--sequences", "4", "--samples", "1", "--device", "cpu"]


@pytest.fixture
def run(tiny_run, tmp_path):
    """A copy with two checkpoints."""
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    shutil.copy(run / "checkpoints" / "last.ckpt", run / "checkpoints" / "best.ckpt")
    return run


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("how", ["option", "argument"])
def test_another_checkpoint_has_results_of_its_own(run, how):
    named = [str(run), "--checkpoint", "best.ckpt"] if how == "option" else [str(run / "checkpoints" / "best.ckpt")]
    before = files(run)

    assert main(["evaluate", *named, *QUICK]) == 0

    added = files(run).keys() - before.keys()
    assert {path.relative_to(run).as_posix() for path in added} == {
        "evaluation-best/.evaluation.lock",
        "evaluation-best/evaluation.json",
        "evaluation-best/evaluation.npz",
    }


def test_results_go_elsewhere_and_the_run_stays_as_it_was(run, tmp_path):
    before = files(run)

    assert main(["evaluate", str(run), *QUICK, "--output", str(tmp_path / "out")]) == 0
    assert main(["evaluate", str(run / "checkpoints" / "best.ckpt"), *QUICK, "--output", str(tmp_path / "out")]) == 0

    assert files(run) == before
    scores = [json.loads((tmp_path / "out" / name / "evaluation.json").read_text()) for name in ("run", "run-best")]
    means = [[entry.get("mean") for entry in record.values()] for record in scores]
    assert means[0] == means[1] != []


def write_entry(run, name):
    write_record(run, {name: {"mean": 0.0}}, {name: torch.zeros(2, dtype=torch.float64)})


def test_evaluations_that_end_together_keep_the_records_of_all(tmp_path, monkeypatch):
    """Slow readers, so that all of them have read before the first has written, unless they wait."""
    read = record.read_arrays

    def read_slowly(run):
        arrays = read(run)
        time.sleep(0.05)
        return arrays

    monkeypatch.setattr(record, "read_arrays", read_slowly)
    names = {f"test/elbo[S={number}]" for number in range(8)}
    threads = [threading.Thread(target=write_entry, args=(tmp_path, name)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert read_record(tmp_path).keys() == read(tmp_path).keys() == names


def test_two_runs_never_write_to_one_folder(run, tmp_path, capsys):
    again = tmp_path / "again" / "run"
    shutil.copytree(run, again)

    assert main(["evaluate", str(run), str(again), *QUICK, "--output", str(tmp_path / "out")]) == 2

    assert "again/run: another run is called run too" in capsys.readouterr().err


def test_a_run_that_cannot_be_written_to_is_one_sentence(run, monkeypatch, capsys):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere

    assert main(["evaluate", str(run), *QUICK]) == 2

    assert "run: cannot be written to. Let the results go elsewhere: --output DIR" in capsys.readouterr().err
