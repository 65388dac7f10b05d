"""One training in several processes: one run, which ends and resumes like that of one process."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import small_agents
from command_line import error_of
from continued_runs import assert_same_run
from ranks import TIMEOUT, environment, finish, start_ranks

from forbes.callbacks import CudaGraph
from forbes.commands.cli import main
from forbes.data import SequenceDataModule
from forbes.data.episodes.store import EpisodeStore
from forbes.errors import ForbesError
from forbes.evaluation.record import read_arrays, read_record
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_config, read_metrics
from forbes.runs.launched import chosen_by_first, launched_devices
from forbes.runs.provenance import read_provenance
from forbes.training.loading import load_run


def start(*command, cwd):
    """Start `python COMMAND` as a user would."""
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def children(process):
    """Return the processes that a process has started, by their rank."""
    pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    found = {}
    for pid in map(int, pids):
        variables = dict(v.split("=", 1) for v in Path(f"/proc/{pid}/environ").read_text().split("\0") if "=" in v)
        found[int(variables["LOCAL_RANK"])] = pid
    return found


def wait_for(pattern, folder):
    """Wait until a file exists, and return its path."""
    end = time.monotonic() + TIMEOUT
    while not (found := list(folder.glob(pattern))):
        assert time.monotonic() < end, f"no {pattern}"
        time.sleep(0.1)
    return found[0]


def only_run():
    [run] = Path("runs").glob("*/*/*")
    return RunFolder(run)


def num_lines(run):
    return len(RunFolder(run).metrics.read_text().splitlines())


def test_two_devices_train_one_run_that_one_can_resume(tiny_config, tiny_run, in_tmp_path, monkeypatch, capsys):
    drawn = {"class_path": "ElboCurve", "init_args": {"every": 1, "sequences": 4}}
    arguments = ["--config", tiny_config, "--trainer.devices", 2, "--trainer.callbacks", f"[{drawn}]"]
    [(status, out, err)] = finish([start("-m", "forbes", "fit", *arguments, cwd=in_tmp_path)])

    assert (status, err) == (0, "")
    run = only_run()
    assert out.count("run folder") == out.count("epoch 2/2") == 1
    assert [entry["exit_status"] for entry in read_provenance(run.provenance)] == [0]
    assert (run.figures / "elbo.png").exists()
    assert num_lines(str(run)) == num_lines(tiny_run)

    last = str(run.checkpoint)
    assert main(["validate", "--config", str(run.config), "--ckpt_path", last, "--trainer.devices", "1"]) == 0
    for name, value in (line.split() for line in capsys.readouterr().out.splitlines()):
        assert read_metrics(str(run))[name].iloc[-1] == pytest.approx(float(value), rel=1e-6)

    numbers, train_index = [], SequenceDataModule.train_index
    monkeypatch.setattr(SequenceDataModule, "train_index", lambda self, n: numbers.append(n) or train_index(self, n))
    assert main(["fit", "--resume", str(run), "--trainer.devices", "1", "--trainer.max_epochs", "3"]) == 0
    assert numbers == [*range(10, 15)]


def test_a_signal_to_one_process_stops_all_with_a_checkpoint(tiny_config, in_tmp_path):
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2]
    arguments = ["--config", tiny_config, "--trainer.max_epochs", 1000]
    process = start(*torchrun, "-m", "forbes", "fit", *arguments, cwd=in_tmp_path)
    wait_for("runs/*/*/*/checkpoints/last.ckpt", in_tmp_path)
    subprocess.run(["kill", "-TERM", str(children(process)[1])], check=True)
    [(status, out, _)] = finish([process])

    run = only_run()
    updates = read_checkpoint(run.checkpoint)["global_step"]
    assert status == 1  # torchrun's own, after the 143 of the first process
    assert f"stopped at update {updates}, resume with: forbes fit --resume {run}" in out
    assert [entry["exit_status"] for entry in read_provenance(run.provenance)] == [128 + signal.SIGTERM]
    assert read_config(run.config)["trainer"]["devices"] == 2


def test_a_process_that_dies_ends_all_and_they_resume_on_any_number(tiny_config, in_tmp_path, monkeypatch):
    """On two, to the bits of a training that was never stopped; on one, with the same batches, but other noise."""
    arguments = ["--config", tiny_config, "--trainer.devices", 2, "--trainer.max_epochs", 1000]
    process = start("-m", "forbes", "fit", *arguments, cwd=in_tmp_path)
    wait_for("runs/*/*/*/checkpoints/last.ckpt", in_tmp_path)
    subprocess.run(["kill", "-KILL", str(children(process)[1])], check=True)
    [(status, _, err)] = finish([process])

    run = only_run()
    assert status == 2
    remedy = f"Resume from its last checkpoint: forbes fit --resume {run}"
    assert err == f"forbes: {run}: a process of this training has ended, so all end. {remedy}\n"
    updates = read_checkpoint(run.checkpoint)["global_step"]
    assert updates % 5 == 0

    alone, straight = shutil.copytree(run.path, in_tmp_path / "alone"), in_tmp_path / "straight"
    length = ["--trainer.max_epochs", updates // 5 + 1]
    resumed = start("-m", "forbes", "fit", "--resume", run, *length, cwd=in_tmp_path)
    never_stopped = start("-m", "forbes", "fit", *arguments, *length, "--run_dir", straight, cwd=in_tmp_path)
    assert [status for status, *_ in finish([resumed, never_stopped])] == [0, 0]
    assert_same_run(run.path, straight)

    numbers, train_index = [], SequenceDataModule.train_index
    monkeypatch.setattr(SequenceDataModule, "train_index", lambda self, n: numbers.append(n) or train_index(self, n))
    assert main(["fit", "--resume", str(alone), *map(str, length), "--trainer.devices", "1"]) == 0
    assert numbers == [*range(updates, updates + 5)]
    before = read_metrics(straight).loc[:updates]
    pd.testing.assert_frame_equal(read_metrics(alone).loc[:updates], before, check_exact=True)


def test_one_process_collects_the_episodes_of_all(tmp_path):
    config = small_agents.write_config(tmp_path)
    fit = ["fit", "--config", config, "--data.batch_size", 4, "--run_dir"]
    ranks = start_ranks("-m", "forbes", "--allow-module", "toy_environments", *fit, tmp_path / "two")
    (status, out, err), other = finish(ranks)
    assert small_agents.forbes(*fit, tmp_path / "one") == 0

    assert (status, err) == (0, "")
    assert other == (0, "", "")
    assert out.count("seed episode") == 2
    two, one = (EpisodeStore(tmp_path / name / "episodes").records for name in ("two", "one"))
    assert [record.seed for record in two.values()] == [record.seed for record in one.values()]
    assert [two[number].sha256 for number in (0, 1)] == [one[number].sha256 for number in (0, 1)]
    metrics, alone = (read_metrics(tmp_path / name) for name in ("two", "one"))
    assert {*metrics} == {*alone}
    for name in ("env_steps", "agent_steps"):
        assert metrics[name].dropna().tolist() == alone[name].dropna().tolist()


def hashes(run):
    return [record.sha256 for record in EpisodeStore(run / "episodes").records.values()]


def test_processes_that_share_the_episodes_out_store_those_of_one(tmp_path):
    """Two seed episodes and three an epoch, by an agent that does not change; the last epoch is resumed by one."""
    config, two, one = small_agents.write_config(tmp_path), tmp_path / "two", tmp_path / "one"
    config.write_text(config.read_text().replace("{seed_episodes: 2", "{episodes: 3, per_rank: true, seed_episodes: 2"))
    rates = [f"--model.{name}=0" for name in ("learning_rate", "actor_rate", "critic_rate")]
    fit = ["fit", "--config", config, "--data.batch_size", 4, *rates]
    on_two = [*fit, "--run_dir", two, "--trainer.max_epochs", 2]

    assert finish(start_ranks("-m", "forbes", "--allow-module", "toy_environments", *on_two))[1] == (0, "", "")
    assert len(hashes(two)) == 5
    assert small_agents.forbes("fit", "--resume", two, "--trainer.max_epochs", 3, "--trainer.devices", 1) == 0
    assert small_agents.forbes(*fit, "--run_dir", one) == 0

    assert hashes(two) == hashes(one)
    assert len({*hashes(one)}) == 8
    for name in ("env_steps", "return/exploring"):
        assert read_metrics(two)[name].dropna().tolist() == read_metrics(one)[name].dropna().tolist()


@pytest.mark.parametrize(
    ("command", "arguments", "sentence"),
    [
        ("fit", ["--trainer.devices", "3"], "SequenceDataModule: batch_size is 4, expected a multiple of 3"),
        (
            "fit",
            ["--trainer.devices", "2", "--on-divergence", "lower-rate"],
            "--on-divergence lower-rate: expected one",
        ),
        ("fit", ["--trainer.devices", "2", "--trainer.limit_val_batches", "2"], "trainer.limit_val_batches: is 2"),
        ("predict", ["--trainer.devices", "2", "--ckpt_path", "x.ckpt"], "forbes predict: prints in order"),
    ],
)
def test_what_several_processes_cannot_do_is_refused(command, arguments, sentence, tiny_config, in_tmp_path, capsys):
    assert error_of(capsys, command, "--config", tiny_config, *arguments).startswith(sentence)
    assert list(in_tmp_path.iterdir()) == []


def test_a_recorded_update_is_that_of_one_process(tiny_run):
    with pytest.raises(ForbesError, match="CudaGraph: records an update of one process, but 2 share every batch"):
        CudaGraph().on_fit_start(SimpleNamespace(world_size=2), load_run(tiny_run)[0])


def test_what_is_not_a_training_uses_one_process(monkeypatch, capsys):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "test")
    monkeypatch.setenv("WORLD_SIZE", "2")

    assert error_of(capsys, "beliefs", "runs/any").startswith(
        "forbes beliefs: uses one process, but torchrun started 2"
    )


def test_two_processes_evaluate_as_one(tiny_run, tmp_path):
    """Twelve sequences in three batches."""
    numbers = ["--samples", 2, "--particles", 4, "--futures", 4, "--context", 2, "--batch-size", 5]
    command = ["evaluate", tiny_run, "--scores", "elbo", "pll", "open-loop", *numbers, "--output"]
    (status, out, err), other = finish(start_ranks("-m", "forbes", *command, tmp_path / "two"))
    assert main([*map(str, command), str(tmp_path / "one")]) == 0

    assert status == 0, err
    assert "elbo" in out
    assert other == (0, "", "")
    two, one = (tmp_path / name / Path(tiny_run).name for name in ("two", "one"))
    scores, expected = read_arrays(two), read_arrays(one)
    assert [*scores] == [*expected]
    for name in expected:
        np.testing.assert_array_equal(scores[name], expected[name])
    entries, alone = read_record(two), read_record(one)
    assert [*entries] == [*alone]
    assert [entry.get("mean") for entry in entries.values()] == [entry.get("mean") for entry in alone.values()]


def test_slurm_says_how_many_processes_there_are(monkeypatch):
    monkeypatch.setenv("SLURM_NTASKS", "8")
    with pytest.raises(ForbesError, match="SLURM: has 8 tasks, expected --ntasks-per-node too"):
        launched_devices()
    monkeypatch.setenv("SLURM_NTASKS_PER_NODE", "4")

    assert launched_devices() == (4, 2)
    with pytest.raises(ForbesError, match="expected a folder for them"):
        chosen_by_first(lambda: "runs/new")
    monkeypatch.setenv("SLURM_JOB_NAME", "interactive")
    assert launched_devices() is None
    assert chosen_by_first(lambda: "runs/new") == "runs/new"
