"""The cost of an update: flow and Gaussian, our form and the textbook form, eager and compiled; and the memory.

    python benchmarks/train_step.py                one thread; writes the table next to this file

All forms of a shape take turns, one update each, so that other programs on the machine affect them equally. Times are
CPU times, which other programs disturb less than wall-clock times; with one thread both are equal on an idle machine.
The ratios are medians over rounds. Memory is measured in a new process per form.
"""

import argparse
import multiprocessing
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml
from textbook import Textbook
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.data import SequenceBatch, SequenceDataModule
from forbes.models import elbo_loss
from forbes.runs.configuration import allow_modules, experiment_parser
from forbes.training import WorldModel

ROOT = Path(__file__).parents[1]
SHAPES = ("strokes", "dmc")
FORMS = ("gaussian", "flow", "textbook")
ACTIONS = 6  # of cheetah-run
TOLERANCE = 1e-4  # relative difference between the losses of our form and the textbook form


def experiment(name: str) -> tuple[WorldModel, SequenceDataModule]:
    """Return model and data of a configuration of digit strokes."""
    allow_modules()
    config = yaml.safe_load((ROOT / "configs" / "strokes" / name).read_text())
    parser = experiment_parser()
    built = parser.instantiate(parser.parse_object({name: config[name] for name in ("model", "data")}))
    return built.model, built.data


def strokes(form: str) -> tuple[WorldModel, SequenceBatch]:
    """Return the model of the default experiment on digit strokes, and its first batch."""
    world, data = experiment("rssm.yaml" if form == "gaussian" else "forbes.yaml")
    return world, data.sequences("train", data.train_index(0))


def dmc(form: str, batch: int) -> tuple[WorldModel, SequenceBatch]:
    """Return the paper's model for DeepMind Control, whose sizes are the class defaults, and a batch of noise."""
    world = WorldModel(GaussianBelief if form == "gaussian" else FlowBelief, action_dim=ACTIONS)
    shape = (batch, 50)
    observation = torch.randint(256, (*shape, 3, 64, 64), dtype=torch.uint8)
    mask = torch.ones(shape, dtype=torch.bool)
    action, no_state = torch.rand(*shape, ACTIONS), torch.zeros(*shape, 0)
    return world, SequenceBatch(observation, action, torch.zeros(shape), mask, no_state, ended=~mask)


class Operations(TorchDispatchMode):
    """Counts the tensor operations that run under it, backward passes included."""

    def __init__(self) -> None:
        super().__init__()
        self.number = 0

    def __torch_dispatch__(self, operation: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        """Count one operation and run it."""
        self.number += 1
        return operation(*arguments, **(options or {}))


class Update:
    """One update of a model on one batch, as `WorldModel` makes it: loss, gradients, clipping, Adam."""

    def __init__(self, shape: str, form: str, dmc_batch: int) -> None:
        torch.manual_seed(0)
        self.world, self.batch = strokes(form) if shape == "strokes" else dmc(form, dmc_batch)
        with torch.no_grad():  # an untrained flow is the identity, and nothing would be compared
            for parameter in self.world.parameters():
                parameter += 0.02 * torch.randn_like(parameter)
        self.model = Textbook(self.world.model) if form == "textbook" else self.world.model
        self.loss: Callable[[], Tensor] = self.eager_loss
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=1e-5, eps=1e-7, fused=True)

    def eager_loss(self) -> Tensor:
        """Return the training loss."""
        terms = self.model.lower_bound(self.batch.observation, self.batch.action, self.batch.mask)
        return elbo_loss(terms, self.world.free_nats, self.world.free_nats_per)

    def loss_of_noise(self, seed: int) -> float:
        """Return the training loss with the noise of a seed."""
        torch.manual_seed(seed)
        with torch.no_grad():
            return self.eager_loss().item()

    def operations(self) -> int:
        """Return the number of tensor operations of an update, which no other program disturbs."""
        with Operations() as operations:
            self()
        return operations.number

    def __call__(self) -> float:
        """Make an update and return the seconds of CPU time it took."""
        start = time.process_time()
        self.optimizer.zero_grad()
        self.loss().backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.world.clip_norm, foreach=True)
        self.optimizer.step()
        return time.process_time() - start


def interleaved(updates: dict[str, Update], repeats: int) -> dict[str, list[float]]:
    """Time updates in turns and return the seconds of each round, without the first two rounds."""
    seconds: dict[str, list[float]] = {form: [] for form in updates}
    for _ in range(repeats + 2):
        for form, update in updates.items():
            seconds[form].append(update())
    return {form: times[2:] for form, times in seconds.items()}


def ratio(times: list[float], others: list[float]) -> float:
    """Return the median over rounds of the ratio of two forms."""
    return statistics.median(a / b for a, b in zip(times, others, strict=True))


def compiled(update: Update) -> float:
    """Compile the loss of an update without graph breaks; return the seconds until the first update is done."""
    torch._inductor.config.force_disable_caches = True  # do not reuse what an earlier run compiled
    start = time.perf_counter()
    update.loss = torch.compile(update.eager_loss, fullgraph=True)
    update()
    return time.perf_counter() - start


def memory(shape: str, form: str, threads: int, dmc_batch: int) -> float:
    """Return the MiB that two updates add to a process that holds model and batch."""
    torch.set_num_threads(threads)
    update = Update(shape, form, dmc_batch)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(2):
        update()
    unit = 2**20 if platform.system() == "Darwin" else 2**10
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / unit


def common_options(description: str | None, repeats: int, of_what: str) -> argparse.ArgumentParser:
    """Return a parser of the options that all benchmarks share; by default the table is written next to the script."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1, help="number of threads of torch")
    parser.add_argument("--repeats", type=int, default=repeats, help=of_what)
    parser.add_argument("--output", type=Path, default=Path(sys.argv[0]).with_suffix(".md"))
    return parser


def conditions(options: argparse.Namespace, machine: str = platform.machine()) -> str:
    """Return a sentence on how a table was measured."""
    return (
        f"torch {torch.__version__} on {machine}, {options.threads} thread(s), medians of {options.repeats} "
        f"interleaved rounds, load average {os.getloadavg()[0]:.1f}."
    )


def publish(table: list[str], options: argparse.Namespace) -> None:
    """Write the table to a file and print it."""
    options.output.write_text("\n".join(table) + "\n")
    print("\n".join(table))


def say(line: str) -> None:
    """Print a line of progress."""
    print(line, file=sys.stderr, flush=True)


def memories(options: argparse.Namespace) -> dict[tuple[str, str], float]:
    """Measure the memory of every form. Call it first, since a child's peak begins at its parent's size."""
    result = {}
    for shape in options.shapes:
        for form in FORMS:
            say(f"{shape}: memory of {form}")
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                result[shape, form] = pool.apply(memory, (shape, form, options.threads, options.dmc_batch))
    return result


def measure(shape: str, needed: dict[tuple[str, str], float], options: argparse.Namespace) -> list[str]:
    """Measure one shape and return the rows of the table."""
    updates = {form: Update(shape, form, options.dmc_batch) for form in FORMS}
    ours, theirs = updates["flow"].loss_of_noise(0), updates["textbook"].loss_of_noise(0)
    assert abs(ours - theirs) <= TOLERANCE * abs(theirs), f"losses differ: {ours} and {theirs}"
    say(f"{shape}: loss {ours:.4f}, textbook {theirs:.4f}; {options.repeats} rounds")
    rows = dict.fromkeys(FORMS, "")
    columns = {form: f"{update.operations()} | {needed[shape, form]:.0f}" for form, update in updates.items()}
    if shape in options.compile:
        updates["compiled"] = Update(shape, "flow", options.dmc_batch)
        say(f"{shape}: compiling")
        rows["compiled"] = f" ({compiled(updates['compiled']):.0f} s to compile)"
    seconds = interleaved(updates, options.repeats)
    return [
        f"| {shape} | {form}{note} | {1e3 * statistics.median(seconds[form]):.0f} "
        f"| {ratio(seconds[form], seconds['gaussian']):.2f} | {ratio(seconds[form], seconds['flow']):.2f} "
        f"| {columns.get(form, ' | ')} |"
        for form, note in rows.items()
    ]


def main() -> None:
    """Measure, print and write the table."""
    parser = common_options(__doc__, 20, "updates of each form")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=SHAPES)
    parser.add_argument("--compile", nargs="*", choices=SHAPES, default=("strokes",), help="shapes to compile as well")
    parser.add_argument(
        "--dmc-batch", type=int, default=8, help="sequences of 50 steps at DMC's shape; the paper has 50"
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    table = [
        f"{conditions(options)} DMC with {options.dmc_batch} sequences of 50 steps.",
        "",
        "| shape | form | ms per update | over gaussian | over flow | operations | MiB that updates need |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    needed = memories(options)
    for shape in options.shapes:
        table += measure(shape, needed, options)
    publish(table, options)


if __name__ == "__main__":
    main()
