"""How costs grow: with steps, sequences, trajectories and particles of an update, digits of an evaluation, episodes.

    python benchmarks/growth.py                one thread; writes the table next to this file

Each size of a cost is measured in turns, in CPU time, and b is fitted to the medians in cost = a size^b. b of the last
two sizes alone shows a cost that becomes superlinear only where it is large.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from evaluate import seconds
from train_step import common_options, conditions, experiment, publish, say

from forbes.beliefs import FlowBelief
from forbes.data import Replay, SequenceBatch
from forbes.data.episodes.episode import Episode
from forbes.data.episodes.store import EpisodeWriter
from forbes.models import MLPDecoder, MLPEncoder, ParticleModel, VectorNormal, elbo_loss
from forbes.training import ImaginationActorCritic, WorldModel

SMALL = {"encoder": MLPEncoder, "decoder": MLPDecoder, "likelihood": VectorNormal(), "action_dim": 2}
SHAPE = {"observation_shape": (2,), **SMALL, "state_dim": 4, "hidden_dim": 64, "mlp_dim": 64, "mlp_layers": 1}
IMAGES = {"action_dim": 6}  # the paper's networks on 64 pixels, the defaults of the classes


class Cost(NamedTuple):
    """A cost, and the seconds of CPU time that it takes at each size."""

    name: str
    expected: float
    """The exponent at large sizes."""
    runs: dict[int, Callable[[], object]]


def update(world: WorldModel, shape: tuple[int, ...], batch: int, length: int) -> None:
    """Compute the loss of a world model on noise, and its gradients."""
    vector = len(shape) == 1
    observation = torch.randn(batch, length, *shape) if vector else torch.zeros(batch, length, *shape).byte()
    action, mask = torch.zeros(batch, length, world.model.action_dim), torch.ones(batch, length, dtype=torch.bool)
    elbo_loss(world.model.lower_bound(observation, action, mask), world.free_nats, world.free_nats_per).backward()


def imagination(agent: ImaginationActorCritic) -> None:
    """Compute the losses of an agent on noise, and their gradients."""
    shape = 8, 16
    mask = torch.ones(shape, dtype=torch.bool)
    batch = SequenceBatch(
        torch.randn(*shape, 2), torch.zeros(*shape, 2), torch.zeros(shape), mask, torch.zeros(*shape, 0), ended=~mask
    )
    agent.total_loss(batch).loss.backward()


def replay(folder: Path, episodes: int) -> Callable[[], object]:
    """Store episodes of 50 frames, and return the function that reads a batch of 16 segments of 16."""
    path = folder / str(episodes)
    environment = {"task": "noise", "observation_shape": [3, 28, 28], "action_dim": 1, "discrete": False}
    frames, nothing = np.zeros((51, 3, 28, 28), np.uint8), np.zeros(51, np.float32)
    with EpisodeWriter(path) as writer:
        for _ in range(episodes):
            writer.append(Episode(frames, nothing[:, None], nothing, False, 50), 0, "test", environment)
    source = Replay(str(path), hold_out=0)
    numbers = iter(range(10**9))
    return lambda: [source.gather("train", source.train_index(16, 16, 0, next(numbers)), 16) for _ in range(20)]


def costs(folder: Path) -> Iterator[Cost]:
    """Return every cost, with the sizes that a CPU core affords."""
    images, flow = WorldModel(**IMAGES), WorldModel(FlowBelief, **SHAPE)
    doubled = (8, 16, 32, 64)
    yield Cost("update, images, B at T = 8", 1, {b: partial(update, images, (3, 64, 64), b, 8) for b in doubled})
    yield Cost("update, images, T at B = 8", 1, {t: partial(update, images, (3, 64, 64), 8, t) for t in doubled})
    yield Cost(
        "update, vectors, B at T = 32", 1, {b: partial(update, flow, (2,), b, 32) for b in (64, 256, 1024, 4096)}
    )
    yield Cost("update, vectors, T at B = 64", 1, {t: partial(update, flow, (2,), 64, t) for t in (16, 32, 64, 128)})
    particles = {
        k: partial(update, WorldModel(model=partial(ParticleModel, particles=k), **SHAPE), (2,), 64, 16)
        for k in (4, 16, 64, 256)
    }
    yield Cost("update, particles, K", 1, particles)
    agents = {n: ImaginationActorCritic(trajectories=n, belief=FlowBelief, **SHAPE) for n in (1, 4, 16, 64)}
    yield Cost("update of an agent, N", 1, {n: partial(imagination, agent) for n, agent in agents.items()})
    world, data = experiment("forbes.yaml")
    world.eval()
    yield Cost("PLL, K, 8 digits", 1, {k: partial(seconds, world.model, data, "pll", 8, k) for k in doubled})
    yield Cost("PLL, digits, K = 8", 1, {n: partial(seconds, world.model, data, "pll", n, 8) for n in doubled})
    yield Cost("20 batches of a replay, episodes", 0, {n: replay(folder, n) for n in (10, 100, 1000)})


def measure(cost: Cost, repeats: int) -> str:
    """Measure a cost at all its sizes in turns, and return its row."""
    times: dict[int, list[float]] = {size: [] for size in cost.runs}
    for _ in range(repeats + 1):
        for size, run in cost.runs.items():
            start = time.process_time()
            run()
            times[size].append(time.process_time() - start)
    medians = {size: statistics.median(found[1:]) for size, found in times.items()}  # the first one allocates
    sizes, found = np.log(list(medians)), np.log(list(medians.values()))
    exponent = np.polyfit(sizes, found, 1)[0]
    last = (found[-1] - found[-2]) / (sizes[-1] - sizes[-2])
    shown = ", ".join(f"{1e3 * median:.0f}" for median in medians.values())
    row = f"| {cost.name} | {', '.join(map(str, medians))} | {shown} | {exponent:.2f} | {last:.2f} | {cost.expected} |"
    say(row)
    return row


def main(options: argparse.Namespace) -> None:
    """Measure, print and write the table."""
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    table = [
        "# How costs grow",
        "",
        conditions(options),
        "",
        "| cost | sizes | ms | b | b of the last two | expected |",
        "|---|---|---|---:|---:|---:|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        table += [measure(cost, options.repeats) for cost in costs(Path(folder))]
    publish(table, options)


if __name__ == "__main__":
    main(common_options(__doc__, 5, "rounds").parse_args())
