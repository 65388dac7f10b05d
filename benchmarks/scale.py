"""What scaling costs: two trainings at a time, one training in two processes, checkpoints, and launchers per job.

    python benchmarks/scale.py                 ten minutes on two cores; writes the table next to this file

Ray is measured on a cluster of its own, of one node of this machine, if it is installed. Times are wall-clock times,
since the processes compete for the cores, so the machine must be idle.
"""

import argparse
import contextlib
import importlib.util
import io
import itertools
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from train_step import common_options, conditions, publish, say

from forbes.commands.jobs import Job, Launcher, run_jobs
from forbes.commands.launchers.local import Local, num_cpus
from forbes.commands.trainings import Training, forbes_command, training_job

EMPTY = 5  # jobs


def seconds(jobs: Sequence[Job], launcher: Launcher) -> float:
    """Return the seconds from the first job's begin to the last one's end."""
    start = time.monotonic()
    with contextlib.redirect_stdout(io.StringIO()) as said:
        ended = run_jobs(jobs, launcher)
    if any(one.status for one in ended):
        raise SystemExit(said.getvalue())
    return time.monotonic() - start


def trainings(folder: Path, number: int, updates: int) -> list[Job]:
    """Return short trainings of FORBES on digit strokes."""
    flags = ("--data.updates_per_epoch", str(updates), "--trainer.max_epochs", "1", "--trainer.callbacks", "[]")
    flags += ("--data.validation_sequences", "20", "--trainer.num_sanity_val_steps", "0")
    found = [Training("strokes/forbes", flags, seed, str(folder / str(seed))) for seed in range(number)]
    return [training_job(training) for training in found]


def side_by_side(options: argparse.Namespace) -> list[str]:
    """Measure two trainings one after the other, which share all cores, and at the same time."""
    table = ["| `--jobs` | threads of each | seconds for two trainings | updates/s together |", "|---:|---:|---:|---:|"]
    times: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(options.repeats):
        for at_once, found in times.items():
            with tempfile.TemporaryDirectory() as folder:
                found.append(seconds(trainings(Path(folder), 2, options.updates), Local(at_once)))
            say(f"--jobs {at_once}: {found[-1]:.1f} s")
    for at_once, found in times.items():
        took = statistics.median(found)
        threads = os.environ.get("OMP_NUM_THREADS") or max(1, num_cpus() // at_once)
        table.append(f"| {at_once} | {threads} | {took:.1f} | {2 * options.updates / took:.2f} |")
    return table


def fit(folder: str, threads: int, *flags: str) -> tuple[float, float]:
    """Train FORBES on digit strokes, and return the seconds it took and its updates per second after the start-up."""
    common = ["strokes/forbes", "--run_dir", folder, "--trainer.callbacks", "[]", "--data.validation_sequences", "20"]
    start = time.monotonic()
    ended = subprocess.run(
        [sys.executable, *forbes_command("fit", *common, *flags)],
        env=os.environ | {"OMP_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
        check=True,
    )
    return time.monotonic() - start, float(re.findall(r"([\d.]+) updates/s", ended.stdout)[-1])


def one_training(options: argparse.Namespace) -> list[str]:
    """Measure one training in one process and in two, with the same batches of 50 sequences."""
    table = ["| processes | threads of each | updates/s | ratio |", "|---:|---:|---:|---:|"]
    rates: dict[tuple[int, int], list[float]] = {(1, 1): [], (1, 2): [], (2, 1): []}
    length = ("--data.updates_per_epoch", str(options.updates), "--trainer.max_epochs", "1")
    for _ in range(options.repeats):
        for (processes, threads), found in rates.items():
            with tempfile.TemporaryDirectory() as folder:
                found.append(fit(f"{folder}/run", threads, *length, "--trainer.devices", str(processes))[1])
            say(f"{processes} processes, {threads} threads each: {found[-1]:.1f} updates/s")
    first = statistics.median(rates[1, 1])
    for (processes, threads), found in rates.items():
        rate = statistics.median(found)
        table.append(f"| {processes} | {threads} | {rate:.2f} | {rate / first:.2f} |")
    return table


def checkpoints(options: argparse.Namespace) -> list[str]:
    """Measure the end of an epoch, with a validation on 20 sequences: mostly the checkpoint, written and synced."""
    table = ["| updates between checkpoints | share of the time |", "|---:|---:|"]
    costs, rates = [], []
    for _ in range(options.repeats):
        seconds_of = {}
        for epochs in (1, 20):
            length = ("--data.updates_per_epoch", str(options.updates // epochs), "--trainer.max_epochs", str(epochs))
            with tempfile.TemporaryDirectory() as folder:
                seconds_of[epochs], rate = fit(f"{folder}/run", 1, *length)
        costs.append((seconds_of[20] - seconds_of[1]) / 19)
        rates.append(rate)
        say(f"a checkpoint: {costs[-1]:.3f} s")
    cost, rate = statistics.median(costs), statistics.median(rates)
    table += [f"| {every} | {cost / (cost + every / rate):.1%} |" for every in (10, 100, 500, 1000)]
    return [f"A checkpoint of 14 MB takes {cost:.3f} s.", "", *table]


@contextmanager
def launchers(folder: Path) -> Iterator[dict[str, Launcher]]:
    """Yield a launcher of each kind, that runs one job at a time."""
    found: dict[str, Launcher] = {"processes of this machine": Local(1)}
    with contextlib.ExitStack() as stack:
        if importlib.util.find_spec("ray"):
            from ray.cluster_utils import Cluster

            from forbes.commands.launchers.ray import Ray

            cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
            stack.callback(cluster.shutdown)
            found["Ray"] = Ray(folder, cluster.address, 1, 0.0, 1)
        yield found


def overhead(options: argparse.Namespace) -> list[str]:
    """Measure jobs that do nothing, one after the other, without the first, which starts what is then reused."""
    table = ["| launcher | first job, s | each further job, s |", "|---|---:|---:|"]
    with tempfile.TemporaryDirectory() as folder, launchers(Path(folder)) as found:
        for name, launcher in found.items():
            times: list[float] = []
            jobs = [Job(str(number), ["-c", "pass"]) for number in range(EMPTY * options.repeats)]
            start = time.monotonic()
            with contextlib.redirect_stdout(io.StringIO()):
                run_jobs(jobs, launcher, on_end=lambda ended, times=times: times.append(time.monotonic()))
            each = statistics.median(b - a for a, b in itertools.pairwise(times))
            table.append(f"| {name} | {times[0] - start:.2f} | {each:.3f} |")
            say(table[-1])
    return table


def main(options: argparse.Namespace) -> None:
    """Measure, print and write the tables."""
    about = f"FORBES on digit strokes, {options.updates} updates each, start-up included."
    table = ["# What many trainings cost", "", conditions(options), ""]
    table += ["## Two trainings on one machine", "", about, "", *side_by_side(options), ""]
    table += ["## One training in several processes", "", "`--trainer.devices N`, the same batches.", ""]
    table += [*one_training(options), "", "## Checkpoints", "", *checkpoints(options), ""]
    table += ["## Overhead of a launcher", "", "Jobs that start Python and exit.", "", *overhead(options)]
    publish(table, options)


if __name__ == "__main__":
    parser = common_options(__doc__, 3, "rounds")
    parser.add_argument("--updates", type=int, default=200, help="updates of each training")
    main(parser.parse_args())
