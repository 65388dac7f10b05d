"""What a machine lacks, or does at the same time: disk, permissions, the clock, two of everything, many of one."""

import itertools
import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from faults.kills import Scenario, compare, goes_on
from faults.outcome import Outcome
from faults.victims import LIMIT, Ending, run
from toy_environments import Parrot

from forbes.envs import EnvironmentProcess

__all__ = ["backwards", "limited", "long_agent", "read_only", "two_at_once", "workers"]

NOBODY = 65534


def limited(scenario: Scenario, expected: dict[str, object], folder: Path, size: int) -> Outcome:
    """Let no file grow beyond a size, as on a disk that is full; then make room and begin again."""
    full = _prepared(scenario, folder, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))
    outcome = Outcome(f"{scenario.name}, no file above {size:,} bytes", reached=full.status != 0)
    outcome.broken += [*_no_sentence(full, folder, {0, 2}), *goes_on(scenario, folder, expected)]
    return outcome


def read_only(scenario: Scenario, expected: dict[str, object], folder: Path) -> Outcome:
    """Let the folder be another user's; then let it be one's own and begin again."""

    def become_another() -> None:
        os.chmod(folder, 0o555)
        if os.getuid() == 0:
            os.setgid(NOBODY)
            os.setuid(NOBODY)

    ending = _prepared(scenario, folder, become_another)
    os.chmod(folder, 0o755)
    broken = [*_no_sentence(ending, folder, {2}), *goes_on(scenario, folder, expected)]
    return Outcome(f"{scenario.name}, a folder that is another user's", broken)


def backwards(scenario: Scenario, expected: dict[str, object], folder: Path) -> Outcome:
    """Let the clock go back by an hour at each look."""
    start, looks = time.time(), itertools.count(1)
    ending = _prepared(scenario, folder, lambda: setattr(time, "time", lambda: start - 3600 * next(looks)))
    broken = [*_no_sentence(ending, folder, {0}), *goes_on(scenario, folder, expected)]
    return Outcome(f"{scenario.name}, a clock that goes back", broken)


def two_at_once(scenario: Scenario, expected: dict[str, object], folder: Path) -> Outcome:
    """Run a command twice in one folder at the same time."""
    scenario.prepare(folder)
    command = [sys.executable, "-m", "forbes", *map(str, scenario.command(folder))]
    how: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    pair = [subprocess.Popen(command, **how) for _ in range(2)]
    said = [process.communicate(timeout=LIMIT)[0] for process in pair]
    outcome = Outcome(f"two of {scenario.name} at once")
    if sorted(process.returncode for process in pair) not in ([0, 0], [0, 2]):
        outcome.broken.append(f"both failed: …{said[0][-300:]} …{said[1][-300:]}")
    elif different := compare(scenario.result(folder), expected):
        outcome.broken.append(f"different: {different}")
    return outcome


def workers(starts: int) -> Outcome:
    """Start and end the process of an environment again and again."""
    outcome = Outcome("the process of an environment", cases=starts)
    EnvironmentProcess(Parrot).close()  # the first also starts what tracks the resources of all
    before = _descriptors()
    for _ in range(starts):
        with EnvironmentProcess(Parrot) as environment:
            environment.reset(0)
    if _descriptors() != before:
        outcome.broken.append(f"{_descriptors() - before} descriptors stay open after {starts} starts")
    return outcome


def long_agent(scenario: Scenario, folder: Path, epochs: int) -> Outcome:
    """Train for many epochs: what is used after a third of them is used at the end."""
    scenario.prepare(folder)
    command = [sys.executable, "-m", "forbes", *map(str, scenario.command(folder)), "--trainer.max_epochs", str(epochs)]
    used: dict[int, _Use] = {}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        for line in process.stdout or ():
            if found := re.match(rf"epoch (\d+)/{epochs}\b", line):
                used[int(found[1])] = _use(process.pid, folder / "run")
    outcome = Outcome(f"{scenario.name}, {epochs} epochs", cases=epochs)
    if process.returncode or len(used) < epochs:
        outcome.broken.append(f"status {process.returncode} after {len(used)} epochs")
        return outcome
    early, late = used[max(1, epochs // 3)], used[epochs - 1]
    if late[1:3] != early[1:3] or late.memory > 1.1 * early.memory or late.disk > 1.1 * early.disk:
        outcome.broken.append(f"grows: {early} after a third of the epochs, {late} at the end")
    outcome.note = f"The agent's process after a third of the {epochs} epochs had {early}, at the end {late}."
    return outcome


class _Use(NamedTuple):
    """What a process uses."""

    memory: int
    descriptors: int
    threads: int
    disk: int

    def __str__(self) -> str:
        memory, disk = f"{self.memory / 2**20:.0f} MiB", f"{self.disk / 2**10:.0f} KiB"
        return f"{memory} of memory, {self.descriptors} descriptors, {self.threads} threads, {disk} on the disk"


def _use(process: int, run: Path) -> _Use:
    """Look at a process, its episodes and its checkpoints; its log does grow, its index up to where it is compacted."""
    status = Path(f"/proc/{process}/status").read_text()
    memory, threads = (int(re.findall(rf"^{name}:\s+(\d+)", status, re.MULTILINE)[0]) for name in ("VmRSS", "Threads"))
    sizes = [path.stat().st_size for path in run.rglob("*.*") if path.suffix in (".npz", ".ckpt")]
    return _Use(1024 * memory, len(os.listdir(f"/proc/{process}/fd")), threads, sum(sizes))


def _prepared(scenario: Scenario, folder: Path, before: Callable[[], object]) -> Ending:
    scenario.prepare(folder)
    return run(scenario.command(folder), folder, before=before)


def _no_sentence(ending: Ending, folder: Path, statuses: set[int]) -> Iterator[str]:
    """Complain of an ending that is neither success nor one sentence, which names the file that cannot be written."""
    line = (ending.output.strip().splitlines() or [""])[-1]
    if ending.status not in statuses or "Traceback" in ending.output:
        yield f"ended with status {ending.status}: …{ending.output[-600:]}"
    elif ending.status == 2 and (str(folder) not in line or len(line.replace(str(folder), "")) > 300):
        yield f"does not name the file: {line}"


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))
