"""What an evaluation costs: whether time grows with K and with the number of digits, and what 1,000 digits would take.

    python benchmarks/evaluate.py                one thread; writes the table beside this file

PLL-K (with the IWAE) and FIVO-K of an untrained `configs/strokes/forbes.yaml`: what weights say changes no cost. K
grows at the first number of digits, the digits at the first K. All settings take turns, and times are of the processor,
as in `train_step.py`. The cost of a digit and a particle is the slope of a line through all settings of a score.
"""

import argparse
import statistics
import time

import numpy as np
import torch
from train_step import common_options, conditions, experiment, publish, say

from forbes.data import SequenceDataModule
from forbes.evaluation.scoring import make_scorer, score_split
from forbes.models import BeliefModel

SCORES = ("pll", "fivo")
DIGITS, PARTICLES = 1000, 128  # of the extrapolation


def seconds(model: BeliefModel, data: SequenceDataModule, name: str, digits: int, particles: int) -> float:
    """Score so many test digits as `forbes evaluate` does, and give the seconds of the processor."""
    score = make_scorer(name, particles, data.batch_size, context=10)
    batches = ((int(index[0]), data.sequences("test", index)) for index in torch.arange(digits).split(score.batch_size))
    start = time.process_time()
    score_split(model, batches, score)
    return time.process_time() - start


def line(times: dict[tuple[int, int], float]) -> tuple[float, float, float]:
    """Fit seconds = fixed + slope · digits · K: give both, and the share of the variance that is not explained."""
    work = np.array([digits * particles for digits, particles in times], float)
    found = np.array(list(times.values()))
    slope, fixed = np.polyfit(work, found, 1)
    return fixed, slope, float(np.var(found - fixed - slope * work) / np.var(found))


def measure(options: argparse.Namespace) -> list[str]:
    """Measure every setting in turns: the rows of the table, and a line for each score."""
    torch.manual_seed(0)
    world, data = experiment("forbes.yaml")
    world.eval()
    few, least = options.digits[0], options.particles[0]
    sizes = [(few, number) for number in options.particles] + [(number, least) for number in options.digits[1:]]
    settings = [(score, *size) for score in SCORES for size in sizes]
    found: dict[tuple[str, int, int], list[float]] = {setting: [] for setting in settings}
    for number in range(options.repeats):
        say(f"round {number + 1} of {options.repeats}")
        for setting in settings:
            found[setting].append(seconds(world.model, data, *setting))
    medians = {setting: statistics.median(times) for setting, times in found.items()}
    rows = [
        f"| {name} | {digits} | {particles} | {time_:.1f} | {1e3 * time_ / digits / particles:.2f} |"
        for (name, digits, particles), time_ in medians.items()
    ]
    for score in SCORES:
        fixed, slope, rest = line({setting[1:]: time_ for setting, time_ in medians.items() if setting[0] == score})
        minutes = (fixed + slope * DIGITS * PARTICLES) / 60
        rows += ["", f"{score}: {fixed:.1f} s + {1e3 * slope:.3f} ms · digits · K, {rest:.1%} of the variance left; "]
        rows[-1] += f"{DIGITS} digits at K = {PARTICLES}: {minutes:.1f} minutes of one core."
    return rows


def main() -> None:
    """Measure, print and write the table."""
    parser = common_options(__doc__, 2, "rounds")
    parser.add_argument("--digits", type=int, nargs="+", default=[50, 100, 200, 400])
    parser.add_argument("--particles", type=int, nargs="+", default=[16, 32, 64, 128])
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    table = [
        conditions(options),
        "",
        "| score | digits | K | seconds | ms per digit and particle |",
        "|---|---:|---:|---:|---:|",
        *measure(options),
    ]
    publish(table, options)


if __name__ == "__main__":
    main()
