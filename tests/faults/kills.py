"""Trainings, evaluations and comparisons that are cut off, and what is left of them."""

import hashlib
import io
import itertools
import json
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch
from faults.outcome import Outcome
from faults.victims import Ending, Fault, run, run_real

from forbes.data.episodes.store import EpisodeStore
from forbes.errors import ForbesError
from forbes.evaluation.record import read_arrays, read_record
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics

__all__ = [
    "Scenario",
    "Whole",
    "compare",
    "comparison",
    "evaluation",
    "goes_on",
    "injections",
    "starting",
    "strike",
    "training",
]

BESIDES = {".lock", ".evaluation.lock", "set_aside"}  # episodes that are played anew stay there


class Whole(NamedTuple):
    """What a command leaves that was not cut off."""

    result: dict[str, object]
    operations: list[str]
    """On files, in their order."""
    seconds: float


@dataclass(eq=False)
class Scenario:
    """A command that can be cut off and begun again.

    Args:
        name: for the report.
        command: gives the arguments for a folder, as a user would go on with what is in it.
        result: gives what must be the same, by name.
        prepare: makes the folder.
        start: runs the command.
    """

    name: str
    command: Callable[[Path], list[object]]
    result: Callable[[Path], dict[str, object]]
    prepare: Callable[[Path], object] = field(default=lambda folder: folder.mkdir(parents=True))
    start: Callable[..., Ending] = run

    def straight(self, folder: Path) -> Whole:
        """Run it without a fault."""
        self.prepare(folder)
        start = time.monotonic()
        ending = self.life(folder, None)
        assert ending.status == 0, ending.output
        return Whole(self.result(folder), ending.operations, time.monotonic() - start)

    def life(self, folder: Path, fault: Fault | None) -> Ending:
        """Run the command once."""
        return self.start(self.command(folder), folder, fault)


def strike(scenario: Scenario, expected: dict[str, object], folder: Path, fault: Fault) -> Outcome:
    """Cut a command off, run it again to its end, and compare."""
    outcome = Outcome(f"{scenario.name}, {fault}")
    scenario.prepare(folder)
    cut = scenario.life(folder, fault)
    outcome.reached = cut.status != 0
    outcome.broken += [complaint for complaint in _of_the_cut(cut, fault) if complaint]
    outcome.broken += goes_on(scenario, folder, expected)
    shutil.rmtree(folder)
    return outcome


def _of_the_cut(cut: Ending, fault: Fault) -> Iterator[str]:
    allowed = {0, -fault.signal, 128 + fault.signal}  # the last two are the same to a shell
    if cut.status not in allowed:
        yield f"ended with status {cut.status}, expected one of {sorted(allowed)}: …{cut.output[-600:]}"
    elif cut.status != -signal.SIGKILL and "Traceback" in cut.output:
        yield f"traceback: …{cut.output[-600:]}"
    if cut.left_over:
        yield f"{len(cut.left_over)} processes outlived it"


def goes_on(scenario: Scenario, folder: Path, expected: dict[str, object]) -> list[str]:
    """Begin a command again; say what is lost, differs, or is left over."""
    ending = scenario.life(folder, None)
    if ending.status != 0:
        return [f"lost: begun again, it ended with status {ending.status}: …{ending.output[-600:]}"]
    try:
        different = compare(scenario.result(folder), expected)
    except ForbesError as error:
        return [f"lost: {error}"]
    return [f"different: {different}"] * bool(different) + [f"left over: {ending.left_over}"] * bool(ending.left_over)


def compare(found: dict[str, object], expected: dict[str, object]) -> str:
    """Say what differs."""
    return ", ".join(sorted(f"{name}" for name, _ in set(found.items()) ^ set(expected.items())))


def injections(whole: Whole, kills: int) -> Iterator[Fault]:
    """Give `kills` faults: a SIGKILL before each operation, evenly thinned; then random signals at random instants."""
    count = len(whole.operations)
    each = min(count, round(0.6 * kills))
    for number in range(each):
        yield Fault(signal.SIGKILL, 1 + number * count // each)
    generator = random.Random(0)
    sent = itertools.cycle(itertools.product([signal.SIGTERM, signal.SIGINT, signal.SIGKILL], [False, True]))
    for number, group in itertools.islice(sent, kills - each):
        by_operation = count and generator.random() < 0.5
        yield Fault(number, generator.randint(1, count) if by_operation else generator.uniform(0, whole.seconds), group)


def training(name: str, config: Path) -> Scenario:
    """`forbes fit`, resumed once there is a checkpoint."""

    def command(folder: Path) -> list[object]:
        run = folder / "run"
        how = ["--resume", run] if RunFolder(run).checkpoint.exists() else ["--config", config, "--run_dir", run]
        return ["--allow-module", "toy_environments", "fit", *how]

    return Scenario(name, command, lambda folder: trained(folder / "run"))


def starting(scenario: Scenario) -> Scenario:
    """The same in a new interpreter, which takes most of its time to start."""
    return Scenario(f"{scenario.name} with start-up", scenario.command, scenario.result, scenario.prepare, run_real)


def evaluation(trained_run: Path) -> Scenario:
    """`forbes evaluate` of a run."""
    return Scenario(
        "evaluation",
        lambda folder: [
            "evaluate",
            folder / "run",
            "--scores",
            "elbo",
            "pll",
            "fivo",
            "--particles",
            "4",
            "--batch-size",
            "5",
        ],
        lambda folder: trained(folder / "run") | measured(folder / "run"),
        lambda folder: shutil.copytree(trained_run, folder / "run"),
    )


def collection() -> Scenario:
    """`forbes data collect`."""
    play = ["--allow-module", "toy_environments", "data", "collect", "--task", "Parrot", "--episodes", "4", "-o"]
    return Scenario("collection", lambda folder: [*play, folder / "store"], lambda folder: contents(folder / "store"))


def comparison(config: Path) -> Scenario:
    """`forbes compare`, whose trainings are processes of their own."""

    def result(folder: Path) -> dict[str, object]:
        return {
            f"{path.parent.name}: {part}": value
            for path in (folder / "out").rglob("config.yaml")
            for part, value in (trained(path.parent) | measured(path.parent)).items()
        }

    def command(folder: Path) -> list[object]:
        return ["compare", config, "--seeds", "1", "--scores", "elbo", "-o", folder / "out"]

    return Scenario("comparison", command, result, start=run_real)


def trained(run: Path) -> dict[str, object]:
    """Give what a training must leave alike: weights, moments, metrics, episodes, and nothing besides."""
    checkpoint = read_checkpoint(RunFolder(run).checkpoint)
    kept = {part: checkpoint[part] for part in ("state_dict", "optimizer_states", "global_step")}
    found = {str(path.relative_to(run)): True for path in run.rglob("*") if not BESIDES & set(path.parts)}
    found |= {"checkpoint": digest(kept), "metrics": read_metrics(run).to_csv()}
    return found | contents(run / "episodes")


def contents(store: Path) -> dict[str, object]:
    """Give the episodes of a store."""
    return {
        f"content of {path.name}": hashlib.sha256(path.read_bytes()).hexdigest() for path in store.glob("*.npz")
    } | {f"of the index: {number}": str(record) for number, record in EpisodeStore(store).records.items()}


def measured(run: Path) -> dict[str, object]:
    """Give what an evaluation must leave alike."""
    record = {f"record of {metric}": entry.get("mean") for metric, entry in read_record(run).items()}
    return record | {f"values of {metric}": values.tobytes() for metric, values in read_arrays(run).items()}


def digest(value: object) -> str:
    """Hash tensors and plain values."""
    buffer = io.BytesIO()
    for path, leaf in sorted(torch.utils._pytree.tree_flatten_with_path(value)[0], key=lambda item: str(item[0])):
        buffer.write(str(path).encode())
        buffer.write(leaf.numpy().tobytes() if isinstance(leaf, torch.Tensor) else json.dumps(leaf).encode())
    return hashlib.sha256(buffer.getvalue()).hexdigest()
