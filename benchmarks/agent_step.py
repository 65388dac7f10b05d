"""What an update of an agent costs, part by part: FORBES against Dreamer, four imagined trajectories against one.

    python benchmarks/agent_step.py                  shapes that a CPU affords; writes the table beside this file
    python benchmarks/agent_step.py --shapes gpu     the paper's sizes

In each round every form makes an update, and each of its parts once more by itself, one form after the other, so that
whatever else the machine does meets them alike. Times are of the processor, or of the clock where a GPU works; ratios
are medians over rounds. Batches are windows of stored random episodes, as in a training. The whole update is the two
parts, and clipping and Adam; on a GPU also as `CudaGraph` plays it back. Acting is one choice of the agent for one
observation.
"""

import argparse
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from train_step import Operations, common_options, conditions, publish, ratio, say

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.callbacks.cuda_graph import Recording
from forbes.control.agent import Agent
from forbes.data import Replay, SequenceBatch, SequenceDataModule
from forbes.data.episodes.collection import collect_episodes, play, random_policy
from forbes.data.episodes.store import EpisodeWriter
from forbes.envs import Environment, Step, find_environment
from forbes.errors import ForbesError
from forbes.models import MLPDecoder, MLPEncoder, VectorNormal
from forbes.training import ImaginationActorCritic

EPISODES = 10
NAMES = {"dreamer": "Dreamer, N = 1", "forbes": "FORBES, N = 1", "forbes4": "FORBES, N = 4"}


class Noise(Environment):
    """Random pictures, as large as a shape asks for: batches cost what they cost, whatever they show."""

    action_dim = 6  # of cheetah-run

    def __init__(self, size: int, steps: int = 100) -> None:
        self.observation_shape, self.steps = (3, size, size), steps

    def reset(self, seed: int) -> Step:
        """See `Environment.reset`."""
        self.random, self.left = np.random.default_rng(seed), self.steps
        return Step(self._picture())

    def step(self, action: Any) -> Step:
        """See `Environment.step`."""
        self.left -= 1
        return Step(self._picture(), reward=float(action[0]), truncated=self.left == 0)

    def _picture(self) -> Any:
        return self.random.integers(256, size=self.observation_shape, dtype=np.uint8)


class Shape(NamedTuple):
    """Sizes of a training; what is not said is the paper's, the default of the classes."""

    environment: Callable[[], Environment]
    batch: int
    length: int
    flow: dict[str, Any]
    model: dict[str, Any]


def small(width: int) -> dict[str, Any]:
    """Give the sizes of an agent whose perceptrons are all of one width and one layer."""
    networks = {name: partial(kind, width=width, layers=1) for name, kind in _PERCEPTRONS.items()}
    return {**networks, "hidden_dim": width, "mlp_dim": width, "mlp_layers": 1, "control_dim": width}


_PERCEPTRONS: dict[str, Any] = {"encoder": MLPEncoder, "decoder": MLPDecoder}
SHAPES = {
    "hike": Shape(  # configs/pomdp/mountain_hike
        find_environment("mountain_hike"),
        16,
        25,
        {"layers": 3, "width": 32},
        {**small(64), "likelihood": VectorNormal(), "state_dim": 4},
    ),
    "pixels": Shape(partial(Noise, 28), 16, 16, {}, {**small(96), "state_dim": 16, "horizon": 10}),
    "dmc": Shape(partial(Noise, 64), 4, 25, {}, {}),  # the paper's networks, a twenty-fifth of its batch
    "gpu": Shape(partial(Noise, 64), 50, 50, {}, {}),
}


class Work:
    """An agent of one form on a device, and each thing that it does again and again."""

    def __init__(self, form: str, shape: Shape, data: SequenceDataModule, device: torch.device, half: bool) -> None:
        torch.manual_seed(0)
        belief = GaussianBelief if form == "dreamer" else partial(FlowBelief, **shape.flow)
        sizes = {"observation_shape": data.observation_shape, "action_dim": data.action_dim, **shape.model}
        number = 4 if form == "forbes4" else 1
        self.agent = ImaginationActorCritic(trajectories=number, belief=belief, **sizes).to(device)
        for name in ("log", "log_dict"):  # there is no trainer to log to
            setattr(self.agent, name, lambda *_, **__: None)
        self.data, self.device, self.number, self.half = data, device, 0, half
        self.optimizer = self.agent.configure_optimizers()["optimizer"]
        self.acting = Agent(self.agent.model, self.agent.action_selector(exploring=True), seed=0)
        self.batch = self.loading()
        with torch.no_grad():
            _, self.filtered = self.agent.follow(self.batch)
        self.losses: Callable[[SequenceBatch], tuple[Tensor, Any]] = self.agent.total_loss
        if device.type == "cuda":
            self.losses = Recording(self.agent, self.batch, self.precision)

    def loading(self) -> SequenceBatch:
        """Draw a batch of windows from the store, and put it on the device."""
        self.number += 1
        compact = self.data.source.gather("train", self.data.train_index(self.number), self.data.length)
        return self.data.source.decode(type(compact)(*(values.to(self.device) for values in compact)))

    def precision(self) -> AbstractContextManager[object]:
        """Give the context in which losses are computed, as Lightning's `bf16-mixed` has it."""
        return torch.autocast("cuda", torch.bfloat16, cache_enabled=False) if self.half else nullcontext()

    def model(self) -> None:
        """Form the gradients of world model and reward."""
        with self.precision():
            seen, filtered = self.agent.follow(self.batch)
            loss, _ = self.agent.model_loss(filtered, seen, self.batch)
        self._backward(loss)

    def imagination(self) -> None:
        """Imagine from beliefs that are there, and form the gradients of actor and critic."""
        with self.precision():
            loss = sum(self.agent.control_losses(self.filtered, self.batch.mask))
        self._backward(loss)

    def update(self) -> None:
        """Make an update: the sum of all losses, gradients, clipping, Adam."""
        with self.precision():
            loss, _ = self.agent.total_loss(self.batch)
        self._step(loss)

    def recorded(self) -> None:
        """Make an update whose losses and gradients are played back, on a GPU."""
        self._step(self.losses(self.batch)[0])

    def act(self) -> None:
        """Choose an action for one observation, as in a collected episode."""
        self.acting(self.batch.observation[0, 0].cpu().numpy())

    def operations(self) -> int:
        """Count the tensor operations of an update: a number that no other program disturbs."""
        with Operations() as operations:
            self.update()
        return operations.number

    def seconds(self) -> dict[str, float]:
        """Do everything once and say how long each took."""
        works = {"loading": self.loading, "model": self.model, "imagination": self.imagination, "update": self.update}
        if self.device.type == "cuda":
            works["recorded"] = self.recorded
        return {part: self._time(work) for part, work in (works | {"acting": self.act}).items()}

    def _step(self, loss: Tensor) -> None:
        self._backward(loss)
        self.agent.configure_gradient_clipping(self.optimizer)
        self.optimizer.step()

    def _backward(self, loss: Tensor) -> None:
        self.optimizer.zero_grad()
        loss.backward()

    def _time(self, work: Callable[[], Any]) -> float:
        """Give the seconds of the processor; those of the clock until a GPU has done it all."""
        if self.device.type == "cpu":
            start = time.process_time()
            work()
            return time.process_time() - start
        torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        torch.cuda.synchronize()
        return time.perf_counter() - start


def stored(shape: Shape, folder: str) -> SequenceDataModule:
    """Play random episodes into a store, and give the batches drawn from it."""
    with EpisodeWriter(folder) as writer:
        list(collect_episodes(shape.environment(), writer, random_policy, "random", EPISODES, seed=0))
    return SequenceDataModule(Replay(folder, hold_out=0), shape.batch, shape.length)


def environment_step(make: Callable[[], Environment]) -> str:
    """Give the milliseconds of one step of a random episode, by the clock: rendering may have threads of its own."""
    try:
        environment = make()
    except ForbesError as error:
        say(str(error))
        return "n/a"
    start = time.perf_counter()
    episode = play(environment, random_policy(environment, 0), seed=0)
    return f"{1e3 * (time.perf_counter() - start) / (len(episode.reward) - 1):.1f}"


def measure(name: str, device: torch.device, options: argparse.Namespace) -> list[str]:
    """Measure one shape: the rows of the table."""
    shape = SHAPES[name]
    make = shape.environment
    if name != "hike":
        size = shape.environment().observation_shape[-1]
        make = find_environment(options.task, size=size, fast=size < 64)
    with tempfile.TemporaryDirectory() as folder:
        data = stored(shape, folder)
        works = {form: Work(form, shape, data, device, options.bf16) for form in NAMES}
        operations = {form: work.operations() for form, work in works.items()}
        rounds: dict[str, list[dict[str, float]]] = {form: [] for form in NAMES}
        say(f"{name}: {options.repeats} rounds")
        for _ in range(options.repeats + 2):
            for form, work in works.items():
                rounds[form].append(work.seconds())
    times = {
        form: {part: [each[part] for each in seconds[2:]] for part in seconds[0]} for form, seconds in rounds.items()
    }
    of_step = environment_step(make)
    return [row(name, form, times, operations[form], of_step) for form in NAMES]


def row(name: str, form: str, times: dict[str, dict[str, list[float]]], operations: int, of_step: str) -> str:
    """Write one row: milliseconds, then ratios of whole updates, round by round."""
    ours = times[form]
    milliseconds = " | ".join(
        f"{1e3 * statistics.median(ours[part]):.1f}" if part in ours else "n/a"
        for part in ("model", "imagination", "update", "recorded")
    )
    over = " | ".join(f"{ratio(ours['update'], times[other]['update']):.2f}" for other in ("dreamer", "forbes"))
    loading = f"{1e3 * statistics.median(ours['loading']):.2f} ({ratio(ours['loading'], ours['update']):.1%})"
    acting = f"{1e3 * statistics.median(ours['acting']):.1f}"
    return f"| {name} | {NAMES[form]} | {milliseconds} | {over} | {operations} | {loading} | {acting} | {of_step} |"


def main() -> None:
    """Measure, print and write the table."""
    parser = common_options(__doc__, 15, "rounds")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=["hike", "pixels", "dmc"])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--bf16", action="store_true", help="mixed precision, on a GPU")
    parser.add_argument("--tf32", action="store_true", help="float32 products of less precision, on a GPU")
    parser.add_argument("--task", default="cartpole_swingup", help="of DeepMind Control, whose step is timed")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.set_float32_matmul_precision("high" if options.tf32 else "highest")
    device = torch.device(options.device)
    machine = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine()
    table = [
        f"{conditions(options, machine)} Milliseconds; loading also as a share.",
        "",
        "| shape | form | world model | imagination | update | recorded | over Dreamer | over N = 1 "
        "| operations | loading | acting | environment |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name in options.shapes:
        table += measure(name, device, options)
    publish(table, options)


if __name__ == "__main__":
    main()
