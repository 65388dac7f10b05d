"""Trainings on a Ray cluster: if a worker, a node or the driver is lost, they continue, to the same bits."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import small_agents
from command_line import error_of
from continued_runs import assert_same_run, starts

import forbes
from forbes.commands.cli import main
from forbes.commands.jobs import Job, run_jobs
from forbes.commands.trainings import Training, training_job
from forbes.data.episodes.store import EpisodeStore
from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder

ray = pytest.importorskip("ray")

from ray.cluster_utils import Cluster  # noqa: E402

from forbes.commands.launchers.ray import Ray, _content_of  # noqa: E402

EPOCHS = ("--trainer.max_epochs", "12")


@pytest.fixture
def cluster(head):
    """A head that takes no jobs, and two nodes with room for one each."""
    while len(head.worker_nodes) < 2:
        head.add_node(num_cpus=1)
    return head


@pytest.fixture(scope="module")
def head():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # with Ray's 15, a test next to others takes for ever
        patch.setenv("RAY_raylet_start_wait_time_s", "120")
        patch.setenv("PYTHONPATH", str(Path(forbes.__file__).parents[1]))  # of the nodes, which import this package
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        yield cluster
        cluster.shutdown()


@pytest.fixture(scope="module")
def straight(tiny_config, tmp_path_factory):
    run = tmp_path_factory.mktemp("straight") / "run"
    assert main(["fit", "--config", str(tiny_config), *EPOCHS, "--run_dir", str(run)]) == 0
    return run


class Watched(Ray):
    """Calls a function once, when a job has come to its third epoch."""

    def __init__(self, *arguments, strike, shared=True):
        super().__init__(*arguments)
        self.strike, self.node, self.shared = strike, "", shared

    def attempt(self, job, say):
        if not self.shared:
            self._mark.unlink(missing_ok=True)

        def watch(line):
            say(line)
            if found := re.search(r"starts on .*, node (\w+)", line):
                self.node = found[1]
            if line.startswith("epoch 3/") and self.strike:
                strike, self.strike = self.strike, None
                strike(self.node)

        return super().attempt(job, watch)


def remove_node(cluster):
    def remove(node):
        (found,) = [each for each in cluster.worker_nodes if each.node_id == node]
        cluster.remove_node(found, allow_graceful=False)

    return remove


def kill_worker(node):
    """Kill the process of the task, whose child is the training."""
    (found,) = subprocess.run(["pgrep", "-f", "^ray::.*/watched$"], capture_output=True).stdout.split()
    os.kill(int(found), signal.SIGKILL)


@pytest.mark.parametrize("shared", [True, False], ids=["shared folder", "brought back"])
@pytest.mark.parametrize("lost", ["node", "worker"])
def test_a_job_continues_elsewhere_to_the_same_bits(lost, shared, cluster, straight, tiny_config, tmp_path, capsys):
    run = tmp_path / "watched"
    strike = remove_node(cluster) if lost == "node" else kill_worker
    launcher = Watched(tmp_path, cluster.address, 1, 0.0, 4, strike=strike, shared=shared)

    (ended,) = run_jobs([training_job(Training(str(tiny_config), EPOCHS, 0, str(run)))], launcher)

    assert (ended.status, launcher.strike) == (0, None)
    assert ": lost: " in capsys.readouterr().out
    first, second = starts(run)
    assert (first, second > 0, second % 5) == (0, True, 0)
    assert_same_run(run, straight)


def test_episodes_that_were_brought_back_are_sent_to_the_next_node(cluster, tmp_path):
    """The memory holds two episodes of 75 steps, so that others are deleted meanwhile."""
    config, hike = small_agents.write_config(tmp_path), ("--data.source.task", "mountain_hike")
    flags = (*hike, "--data.source.options", "{}", "--data.source.capacity", "200", "--trainer.max_epochs", "6")
    straight, run = tmp_path / "straight", tmp_path / "watched"
    assert main(["fit", "--config", str(config), *flags, "--run_dir", str(straight)]) == 0
    launcher = Watched(tmp_path, cluster.address, 1, 0.0, 4, strike=kill_worker, shared=False)

    (ended,) = run_jobs([training_job(Training(str(config), flags, 0, str(run)))], launcher)

    assert (ended.status, launcher.strike) == (0, None)
    assert starts(run)[1] > 0
    assert_same_run(run, straight)
    stored, expected = (EpisodeStore(folder / "episodes") for folder in (run, straight))
    assert stored.files() == expected.files() == [*range(3, 7)]
    stored.verify(stored.files())


def test_configurations_travel_and_data_do_not(tiny_config, strokes_file):
    """A run records the path of its data, and is resumed and evaluated elsewhere."""
    arguments = ["--config", str(tiny_config), "--data.source.path", str(strokes_file)]

    assert _content_of(Job("one", ["-m", "forbes", "fit", *arguments])).named == {
        str(tiny_config): tiny_config.read_bytes()
    }


def test_a_folder_that_another_process_holds_is_not_written_to(cluster, tiny_config, tmp_path):
    """Nor is it seen by the node, which does not share it."""
    jobs = [training_job(Training(str(tiny_config), EPOCHS, 0, str(tmp_path / name))) for name in ("held", "free")]
    launcher = Watched(tmp_path, cluster.address, 1, 0.0, 4, strike=None, shared=False)

    with RunFolder(tmp_path / "held").locked():
        held, free = run_jobs(jobs, launcher)

    assert held.reason.startswith(f"ended with status 2: forbes: {tmp_path}/held: process {os.getpid()} on ")
    assert free.status == 0
    assert not (tmp_path / "held" / "metrics.jsonl").exists()


def test_jobs_share_a_gpu(head, tmp_path):
    """Four at most have a quarter of one each, and see it under its number."""
    node = head.add_node(num_cpus=2, num_gpus=1)
    job = ["-c", "import os; print('GPU', os.environ['CUDA_VISIBLE_DEVICES'])"]

    ended = run_jobs([Job(name, job) for name in "ab"], Ray(tmp_path, head.address, 1, 0.25, 4))
    head.remove_node(node)

    assert [(one.status, one.last) for one in ended] == [(0, "GPU 0")] * 2


def test_an_interrupt_stops_the_job_with_a_checkpoint(cluster, straight, tiny_config, tmp_path):
    run, job = tmp_path / "run", Training(str(tiny_config), EPOCHS, 0, str(tmp_path / "run"))

    def interrupt(node):
        os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(SystemExit):
        run_jobs([training_job(job)], Watched(tmp_path, cluster.address, 1, 0.0, 4, strike=interrupt))
    assert read_checkpoint(RunFolder(run).checkpoint)["global_step"] < 60

    (ended,) = run_jobs([training_job(job)], Ray(tmp_path, cluster.address, 1, 0.0, 4))

    assert ended.status == 0
    assert_same_run(run, straight)


def test_the_same_command_continues_after_its_driver_was_killed(cluster, straight, tiny_config, tmp_path):
    arguments = ["compare", str(tiny_config), "--launcher", "ray", "--address", cluster.address, "-o", str(tmp_path)]
    command = [sys.executable, "-m", "forbes", *arguments, "--scores", "elbo", "--samples", "2", "--", *EPOCHS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as driver:
        while "epoch 3/" not in driver.stdout.readline():
            pass
        driver.kill()

    again = subprocess.run(command, capture_output=True, text=True)

    assert again.returncode == 0, again.stderr
    assert len(starts(tmp_path / "forbes-0")) == 2
    assert_same_run(tmp_path / "forbes-0", straight)


def test_a_cluster_of_another_version_is_refused_with_the_reason(tmp_path, monkeypatch):
    def mismatch(**options):
        raise RuntimeError("Version mismatch:\n  The cluster has 2.9")

    monkeypatch.setattr(ray, "init", mismatch)

    with pytest.raises(ForbesError, match=r"cannot be joined \(Version mismatch: The cluster has 2.9\)"):
        run_jobs([Job("one", ["-c", "pass"])], Ray(tmp_path, "auto", 1, 0.0, 1))


def test_without_a_cluster_it_says_how_to_start_one(tiny_config, tmp_path, capsys):
    options = ["--launcher", "ray", "--address", "127.0.0.1:1", "-o", tmp_path, "--context", "2"]

    error = error_of(capsys, "compare", tiny_config, *options)

    assert error.startswith("--launcher ray: no Ray cluster at 127.0.0.1:1. Start one: ray start --head")
