"""Runs of an earlier version, made at commit 0aad89b: they are measured, resumed, and their configurations trained."""

import shutil
from pathlib import Path

import pytest

from forbes.commands.cli import main
from forbes.evaluation.record import read_record
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.provenance import read_provenance

OLD_RUNS = Path(__file__).parents[1] / "old_runs"


@pytest.fixture(params=["strokes", "agent"])
def old_run(request, tmp_path):
    return RunFolder(shutil.copytree(OLD_RUNS / request.param, tmp_path / request.param))


def test_an_old_run_is_evaluated(old_run):
    of_agent, of_world = (
        ["--episodes", "2"],
        ["--sequences", "4", "--particles", "2", "--futures", "2", "--context", "2"],
    )

    assert main(["evaluate", str(old_run), *(of_agent if old_run.path.name == "agent" else of_world)]) == 0

    names = " ".join(read_record(old_run.path))
    assert "test[:4]/pll[bernoulli,K=2]" in names or "return[episodes=2]" in names


def test_an_old_run_is_resumed(old_run):
    before = read_metrics(old_run.path)

    assert main(["fit", "--resume", str(old_run), "--trainer.max_epochs", "3"]) == 0

    assert read_checkpoint(old_run.checkpoint)["global_step"] == 15
    assert read_metrics(old_run.path).loc[before.index, before.columns].equals(before)
    assert len(read_provenance(old_run.provenance)) == 2


def test_the_configuration_of_an_old_run_trains_again(old_run, tmp_path):
    assert main(["fit", "--config", str(old_run.config), "--run_dir", str(tmp_path / "new")]) == 0

    assert read_checkpoint(RunFolder(tmp_path / "new").checkpoint)["global_step"] == 10
