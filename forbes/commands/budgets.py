"""What `forbes reproduce` trains, measures and draws: plain lists, by part of the paper and by budget."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from forbes.commands.trainings import Training
from forbes.evaluation.claims import DMC_TASKS
from forbes.evaluation.contrasts import task_of
from forbes.figures.catalogue import find_figure

__all__ = ["Family", "Planned", "Step", "collections", "families", "figures", "measures", "trainings"]


class Size(NamedTuple):
    """How much of a family is trained."""

    epochs: int
    seeds: int


class Family(NamedTuple):
    """A configuration that is trained with several seeds."""

    name: str
    """Group and name, e.g. `strokes/rssm_wide`: the run folder without the seed."""
    config: str
    """Name of the configuration."""
    measure: str
    """How its runs are measured: a key of `_MEASURES`."""
    per_epoch: int
    """Updates per epoch in the configuration."""
    rate: float
    """Recorded updates per second on one CPU core, validation and acting included."""
    sizes: dict[str, Size]
    """Size by budget."""
    flags: tuple[str, ...] = ()
    gpu_rate: float | None = None
    """Recorded updates per second on a GPU."""


class Planned(NamedTuple):
    """A training of a budget."""

    family: Family
    training: Training
    updates: int

    def hours(self, measured: float | None, gpu: bool) -> float:
        """Return the expected hours, by the measured updates per second, else by the recorded ones."""
        recorded = self.family.gpu_rate if gpu and self.family.gpu_rate else self.family.rate
        return (_START + self.updates / (measured or recorded)) / 3600


class Step(NamedTuple):
    """A `forbes` command that measures or draws finished runs."""

    name: str
    arguments: tuple[str, ...]
    runs: tuple[str, ...]
    """Run folders that it reads."""
    hours: float
    pictures: str = ""
    """What its pictures show, if they belong on the page. They are in the folder after `-o`."""


_START = 10.0  # seconds until the first update
_ONE = Size(2, 1)
_DRY = ("--data.batch_size", "4", "--data.updates_per_epoch", "5", "--trainer.log_every_n_steps", "1")
_SMOKE_FLAGS = {
    "strokes": (*_DRY, "--data.validation_sequences", "20", "--trainer.callbacks", "[ParameterCount, ElboCurve]"),
    "processes": (*_DRY, "--data.validation_sequences", "20"),
    "beliefs": (*_DRY, "--data.validation_sequences", "20"),
    "agents": (
        *(*_DRY, "--data.length", "10", "--trainer.callbacks"),
        "[{class_path: Collect, init_args: {seed_episodes: 2, evaluate_every: 1, evaluation_episodes: 2}}]",
    ),
}
"""A few small updates, and few validations."""
_SMOKE_PER_EPOCH = 5


def _strokes() -> Iterable[Family]:
    for name, rate in (("forbes", 4.5), ("rssm", 7.3), ("rssm_wide", 6.5)):
        sizes = {"smoke": _ONE, "small": Size(6, 3), "paper": Size(40, 5)}
        yield Family(f"strokes/{name}", f"strokes/{name}", "strokes", 500, rate, sizes)
    yield Family("strokes/vector", "strokes/vector", "strokes", 500, 6.0, {"small": Size(6, 1), "paper": Size(40, 1)})


def _processes() -> Iterable[Family]:
    for process in ("mirror_sensor", "multi_start_hike"):
        for name, rate in (("forbes", 14.0), ("rssm_wide", 25.0), ("particle", 6.0)):
            sizes = {"small": Size(10, 3), "paper": Size(20, 5)}
            if process == "mirror_sensor":
                sizes["smoke"] = _ONE
            yield Family(f"{process}/{name}", f"pomdp/{process}/{name}", "processes", 200, rate, sizes)
    elbo = ("--model.objective", "elbo")
    for name, config, rate, flags in (
        ("known_gaussian", "known_gaussian", 60.0, ()),
        ("known_spline", "known_spline", 30.0, ()),
        ("known_spline_elbo", "known_spline", 30.0, elbo),
    ):
        sizes = {"smoke": _ONE, "small": Size(10, 3), "paper": Size(20, 5)}
        yield Family(f"mirror_sensor/{name}", f"pomdp/mirror_sensor/{config}", "beliefs", 200, rate, sizes, flags)


def _control() -> Iterable[Family]:
    for name, config, rate, flags in (
        ("forbes", "forbes", 3.4, ()),
        ("forbes_n1", "forbes", 7.5, ("--model.trajectories", "1")),
        ("dreamer", "dreamer", 10.0, ()),
        ("dreamer_n4", "dreamer", 4.5, ("--model.trajectories", "4")),
    ):
        sizes = {"small": Size(120, 3), "paper": Size(120, 5)}
        if name in ("forbes", "dreamer"):
            sizes["smoke"] = _ONE
        yield Family(f"mountain_hike/{name}", f"pomdp/mountain_hike/agent_{config}", "agents", 25, rate, sizes, flags)
    for task, (name, rate, gpu_rate) in itertools.product(DMC_TASKS, _DMC_AGENTS):
        paper, of_task = {"paper": Size(500, 3)}, ("--data.source.task", task)
        yield Family(f"{task}/{name}", f"dmc/{name}", "agents", 100, rate, paper, of_task, gpu_rate)
    for task, (name, rate, gpu_rate) in itertools.product(DMC_TASKS, (("forbes", 0.09, 30.0), ("rssm", 0.11, 40.0))):
        config, paper = f"dmc/world_model_{name}", {"paper": Size(40, 3)}
        yield Family(f"{task}/world_model_{name}", config, "episodes", 500, rate, paper, (), gpu_rate)


_DMC_AGENTS = (
    ("forbes", 0.047, 10.6),
    ("forbes_n2", 0.06, 12.0),
    ("forbes_n1", 0.07, 13.0),
    ("dreamer", 0.08, 13.9),
    ("dreamer_n4", 0.05, 11.0),
    ("dreamer_plus1", 0.08, 13.5),
    ("dreamer_plus2", 0.08, 13.0),
)
"""Agents of DeepMind Control, with updates per second on a CPU core and on a GPU, derived from `benchmarks`."""
_PARTS = {"strokes": _strokes, "processes": _processes, "control": _control}


def families(part: str, budget: str) -> list[Family]:
    """Return the families of a part that a budget trains."""
    return [family for family in _PARTS[part]() if budget in family.sizes]


def trainings(part: str, budget: str, folder: Path) -> list[Planned]:
    """Return the trainings of a part, seed by seed, so that each claim has a first answer early."""
    planned = []
    for family in families(part, budget):
        size, per_epoch, flags = family.sizes[budget], family.per_epoch, family.flags
        if budget == "smoke":
            per_epoch, flags = _SMOKE_PER_EPOCH, (*flags, *_SMOKE_FLAGS[family.measure])
        if family.measure == "episodes":
            flags = (*flags, "--data.source.path", str(_episodes(folder, family)))
        for seed in range(size.seeds):
            epochs = ("--trainer.max_epochs", str(size.epochs))
            training = Training(family.config, (*flags, *epochs), seed, str(folder / f"{family.name}-{seed}"))
            planned.append(Planned(family, training, size.epochs * per_epoch))
    return sorted(planned, key=lambda one: one.training.seed)


def collections(planned: Sequence[Planned], folder: Path) -> list[Step]:
    """Return the collections of the episodes that the trainings read."""
    tasks = {_episodes(folder, one.family) for one in planned if one.family.measure == "episodes"}
    return [
        Step(f"collect-{path.name}", ("data", "collect", "--task", path.name, "-o", str(path), *_COLLECTED), (), 0.5)
        for path in sorted(tasks)
    ]


_COLLECTED = ("--episodes", "40")


def _episodes(folder: Path, family: Family) -> Path:
    return folder / "episodes" / task_of(family.name)


class _Measured(NamedTuple):
    """How runs of a kind are measured together, by budget: arguments of `forbes`, and hours per run."""

    smoke: tuple[str, ...]
    full: tuple[str, ...]
    hours: float


_MEASURES = {
    "strokes": _Measured(
        ("evaluate", "--scores", "elbo", "pll", "--sequences", "10", "--samples", "2", "--particles", "2"),
        ("evaluate", "--scores", "elbo", "pll", "--sequences", "1000", "--particles", "32"),
        0.02,
    ),
    "processes": _Measured(
        ("evaluate", "--scores", "elbo", "pll", "--sequences", "10", "--samples", "2", "--particles", "8"),
        ("evaluate", "--scores", "elbo", "pll", "fivo", "--sequences", "300"),
        0.007,
    ),
    "beliefs": _Measured(
        ("beliefs", "--sequences", "4", "--samples", "2"),
        ("beliefs", "--sequences", "200", "--samples", "4"),
        0.01,
    ),
    "agents": _Measured(("evaluate", "--episodes", "2"), ("evaluate", "--episodes", "100"), 0.02),
    "episodes": _Measured((), ("evaluate", "--scores", "elbo"), 0.5),
}
_COMPLETED = ("strokes/forbes", "strokes/rssm_wide")
"""The families whose completions are compared: the first minus the second."""
_COMPLETIONS = {"smoke": ("4", "2"), "small": ("100", "50"), "paper": ("300", "100")}
"""Digits, and completions of each, by budget."""
_PREFIX = "10"


def measures(planned: Sequence[Planned], budget: str, folder: Path) -> list[Step]:
    """Return the measurements of finished runs: those of one group and seed together, so that they can be paired."""
    groups: dict[str, list[Planned]] = {}
    for one in planned:
        name = f"{task_of(one.family.name)}-{one.family.measure}-{one.training.seed}"
        groups.setdefault(name, []).append(one)
    steps = []
    for name, members in groups.items():
        measured, runs = _MEASURES[members[0].family.measure], tuple(one.training.folder for one in members)
        command, *options = measured.smoke if budget == "smoke" else measured.full
        hours = 0.002 if budget == "smoke" else measured.hours * len(runs)
        steps.append(Step(f"{command}-{name}", (command, *runs, *options), runs, hours))
    return [*steps, *_completions(planned, budget, folder)]


def _completions(planned: Sequence[Planned], budget: str, folder: Path) -> Iterable[Step]:
    runs = {(one.family.name, one.training.seed): one.training.folder for one in planned}
    digits, samples = _COMPLETIONS[budget]
    for seed in range(max((seed for _, seed in runs), default=-1) + 1):
        if all((family, seed) in runs for family in _COMPLETED):
            name, pair = f"completions-{seed}", tuple(runs[family, seed] for family in _COMPLETED)
            options = ("--digits", digits, "--samples", samples, "--prefixes", _PREFIX, "-o", str(folder / name))
            hours = int(digits) * 2 * 0.8 / 3600
            pictures = "" if seed else f"strokes: completions after {_PREFIX} steps, their classes and errors (ours)"
            yield Step(name, ("completions", *pair, *options), pair, hours, pictures)


class Drawn(NamedTuple):
    """A figure of the catalogue, and the families that it shows."""

    name: str
    about: str
    """What its runs are about; with the name, the name of its folder."""
    families: tuple[str, ...]
    seeds: int | None = None
    """Number of seeds; None for all."""


def _named(tasks: Iterable[str], *names: str) -> tuple[str, ...]:
    """Return the families of these names, name by name."""
    return tuple(f"{task}/{name}" for name in names for task in tasks)


_STROKES = _named(["strokes"], "forbes", "rssm", "rssm_wide")
_KNOWN = _named(["mirror_sensor"], "known_gaussian", "known_spline", "known_spline_elbo")
_MIRROR, _HIKE = (_named([name], "forbes", "rssm_wide", "particle") for name in ("mirror_sensor", "multi_start_hike"))
_FIGURES = (
    Drawn("beliefs", "mirror_sensor", _MIRROR, 1),
    Drawn("beliefs", "multi_start_hike", _HIKE, 1),
    Drawn("beliefs", "mirror_sensor_known", _KNOWN, 1),
    Drawn("predictions", "strokes", _named(["strokes"], "forbes", "rssm_wide"), 1),
    Drawn("elbo", "strokes", _STROKES),
    Drawn("per-step", "strokes", _STROKES),
    Drawn("prequential", "strokes", _STROKES),
    Drawn("simcore", "strokes", _named(["strokes"], "forbes", "vector"), 1),
    Drawn("calibration", "strokes", _named(["strokes"], "forbes", "rssm_wide"), 1),
    Drawn("elbo", "mirror_sensor", _MIRROR),
    Drawn("elbo", "multi_start_hike", _HIKE),
    Drawn("returns", "mountain_hike", _named(["mountain_hike"], "forbes", "dreamer")),
    Drawn("trajectories", "mountain_hike", _named(["mountain_hike"], "forbes", "dreamer", "dreamer_n4")),
    Drawn("trajectories-n", "mountain_hike", _named(["mountain_hike"], "forbes", "forbes_n1")),
    Drawn("returns", "dmc", _named(DMC_TASKS, "forbes", "dreamer")),
    Drawn("trajectories", "dmc", _named(DMC_TASKS, "forbes", "dreamer", "dreamer_n4")),
    Drawn("trajectories-n", "dmc", _named(DMC_TASKS, "forbes", "forbes_n2", "forbes_n1")),
    Drawn("layers", "dmc", _named(DMC_TASKS, "forbes", "dreamer", "dreamer_plus1", "dreamer_plus2")),
    Drawn("dmc-elbo", "dmc", _named(DMC_TASKS, "world_model_forbes", "world_model_rssm")),
    Drawn("reconstructions", "dmc", _named(DMC_TASKS, "world_model_forbes", "world_model_rssm"), 1),
)


def figures(planned: Sequence[Planned], folder: Path) -> list[Step]:
    """Return the commands that draw the figures of finished runs, each into a folder of its own.

    Each figure compares families, so it is left out if fewer than two of them have a run.
    """
    steps = []
    for name, about, shown, seeds in _FIGURES:
        members = [
            one
            for family in shown
            for one in planned
            if one.family.name == family and (seeds is None or one.training.seed < seeds)
        ]
        if len({one.family.name for one in members}) > 1:
            runs = tuple(one.training.folder for one in members)
            output, entry = folder / "figures" / f"{name}-{about}", find_figure(name)
            number = f"Figure {entry.number}" if entry.number.isdigit() else entry.number
            arguments = ("figures", name, "--runs", *runs, "-o", str(output))
            steps.append(
                Step(output.name, arguments, runs, 0.01, f"{about.replace('_', ' ')}: {entry.shows} ({number})")
            )
    return steps
