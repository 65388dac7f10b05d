"""Trainings as SLURM jobs: preempted or cancelled, they continue from their last update, to the same bits."""

import os
import signal
import subprocess
import time

import fake_slurm
import pytest
from command_line import error_of
from continued_runs import assert_same_run, starts

from forbes.commands.cli import main
from forbes.commands.jobs import Job, run_jobs
from forbes.commands.trainings import Training, training_job
from forbes.errors import ForbesError

submitit = pytest.importorskip("submitit")

from forbes.commands.launchers import slurm  # noqa: E402
from forbes.commands.launchers.slurm import Slurm  # noqa: E402

EPOCHS = ("--trainer.max_epochs", "12")


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Look for lines often, and do not wait long for a result that never comes."""
    monkeypatch.setattr(slurm, "_POLL", 0.05)
    monkeypatch.setattr(submitit.Job, "_results_timeout_s", 1)


@pytest.fixture
def local(monkeypatch):
    """Submit to processes of this machine, by the executor that submitit has for tests."""

    def executor(folder, options, at_once):
        found = submitit.LocalExecutor(folder)
        found.update_parameters(timeout_min=60)
        return found

    monkeypatch.setattr(slurm, "_executor", executor)


@pytest.fixture(scope="module")
def straight(tiny_config, tmp_path_factory):
    run = tmp_path_factory.mktemp("straight") / "run"
    assert main(["fit", "--config", str(tiny_config), *EPOCHS, "--run_dir", str(run)]) == 0
    return run


class Watched(Slurm):
    """Calls a function with the submitted job once, when it has come to its third epoch."""

    def __init__(self, *arguments, strike):
        super().__init__(*arguments)
        self.strike = strike

    def attempt(self, job, say):
        def watch(line):
            say(line)
            if "epoch 3/" in line and self.strike:
                strike, self.strike = self.strike, None
                strike(self._known[job.name])

        return super().attempt(job, watch)


def children(process):
    return [int(pid) for pid in subprocess.run(["pgrep", "-P", str(process)], capture_output=True).stdout.split()]


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGUSR2])
def test_a_preempted_job_is_queued_again_and_resumes(number, local, straight, tiny_config, tmp_path):
    def preempt(handle):
        (process,) = children(handle._process.pid)
        os.kill(process, number)

    launcher = Watched(tmp_path, [], 4, strike=preempt)

    (ended,) = run_jobs([training_job(Training(str(tiny_config), EPOCHS, 0, str(tmp_path / "run")))], launcher)

    assert (ended.status, launcher.strike) == (0, None)
    assert len(starts(tmp_path / "run")) == 2
    assert len([*(tmp_path / "slurm").glob("*_submitted.pkl")]) == 1  # it was not submitted twice
    assert_same_run(tmp_path / "run", straight)


def test_each_job_tells_its_status_and_last_line(local, tmp_path):
    codes = {"good": "print('fine')", "bad": "print('why'); raise SystemExit(3)"}

    good, bad = run_jobs([Job(name, ["-c", code]) for name, code in codes.items()], Slurm(tmp_path, [], 4))

    assert (good.status, good.last) == (0, "fine")
    assert bad.reason == "ended with status 3: why"


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    submitit.SlurmJob.watcher.clear()  # the numbers of the jobs begin anew
    return fake_slurm.install(tmp_path / "cluster", monkeypatch)


def jobs_of(tiny_config, tmp_path):
    trainings = [Training(str(tiny_config), EPOCHS, seed, str(tmp_path / f"run-{seed}")) for seed in range(2)]
    return [training_job(training) for training in trainings]


@pytest.mark.parametrize(
    ("signals", "submitted"), [((signal.SIGTERM, signal.SIGUSR2), 1), ((signal.SIGTERM,), 2)], ids=["both", "SIGTERM"]
)
def test_an_array_with_the_options_survives_a_preemption(signals, submitted, cluster, straight, tiny_config, tmp_path):
    """SLURM sends SIGTERM to all processes of a job, and if it is set up so the announced signal."""

    def preempt(handle):
        processes = fake_slurm.processes_of(cluster, handle.job_id)
        for number in signals:
            for process in processes:
                os.kill(process, number)

    options = ["partition=gpu", "time=240", "gpus-per-node=1", "mem=16G"]
    launcher = Watched(tmp_path, options, 1, strike=preempt)

    ended = run_jobs(jobs_of(tiny_config, tmp_path)[:1], launcher)

    assert [one.status for one in ended] == [0]
    script, *again = fake_slurm.submissions(cluster)
    assert 1 + len(again) == submitted
    wanted = ("partition=gpu", "time=240", "gpus-per-node=1", "mem=16G", "requeue", "signal=USR2@120")
    assert not [option for option in wanted if f"#SBATCH --{option}\n" not in script]
    assert len(starts(tmp_path / "run-0")) == 2
    assert_same_run(tmp_path / "run-0", straight)


@pytest.mark.parametrize(("options", "threads"), [([], "1"), (["cpus-per-task=3"], "3")])
def test_a_job_has_the_cpus_that_were_asked_for(options, threads, cluster, tmp_path, monkeypatch):
    """Since SLURM 22.05, srun does not take their number from sbatch."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    jobs = [Job("one", ["-c", "import os; print(os.environ['OMP_NUM_THREADS'])"])]

    (ended,) = run_jobs(jobs, Slurm(tmp_path, options, 1))

    assert (ended.status, ended.last) == (0, threads)


def test_jobs_that_slurm_refuses_are_said_with_its_reason(cluster, tmp_path):
    refused = r"SLURM refuses the jobs \(sbatch: error: invalid partition specified: none\). Change --slurm"
    with pytest.raises(ForbesError, match=refused):
        run_jobs([Job("one", ["-c", "pass"])], Slurm(tmp_path, ["partition=none"], 1))


def test_a_second_command_waits_for_the_jobs_of_the_first(cluster, straight, tiny_config, tmp_path):
    jobs, first = jobs_of(tiny_config, tmp_path), Slurm(tmp_path, [], 1)
    with first.ready(jobs):
        pass  # as if killed here: the jobs go on

    ended = run_jobs(jobs, Slurm(tmp_path, [], 1))

    assert [one.status for one in ended] == [0, 0]
    (script,) = fake_slurm.submissions(cluster)
    assert "#SBATCH --array=0-1%1\n" in script
    assert len(starts(tmp_path / "run-0")) == 1
    assert_same_run(tmp_path / "run-0", straight)


def test_an_interrupt_cancels_the_jobs_and_the_same_command_continues(cluster, straight, tiny_config, tmp_path):
    def interrupt(handle):
        os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(SystemExit):
        run_jobs(jobs_of(tiny_config, tmp_path)[:1], Watched(tmp_path, [], 1, strike=interrupt))
    assert (cluster / "100.state").read_text().startswith("CANCELLED")
    while fake_slurm.processes_of(cluster, "100"):  # until the training has stopped with its checkpoint
        time.sleep(0.2)

    (ended,) = run_jobs(jobs_of(tiny_config, tmp_path)[:1], Slurm(tmp_path, [], 1))

    assert ended.status == 0
    assert_same_run(tmp_path / "run-0", straight)


def test_what_is_wrong_is_said_in_one_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PATH", "")

    def error(*options):
        return error_of(capsys, "compare", "strokes/forbes", "--launcher", "slurm", "-o", tmp_path, *options)

    assert error() == "--launcher slurm: srun is missing here. Run the command on a machine of the cluster"
    assert error("--slurm", "partition") == "--slurm partition: expected KEY=VALUE of sbatch, e.g. partition=gpu"
    assert error("--slurm", "time=4:00:00") == "--slurm time=4:00:00: expected a whole number of minutes"
