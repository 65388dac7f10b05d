"""Find the environment of a task by name."""

import difflib
import inspect
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from forbes.envs.base import Environment
from forbes.envs.dm_control import DeepMindControl
from forbes.envs.gymnasium import Gymnasium
from forbes.envs.memory_maze import SIZES, MemoryMaze
from forbes.envs.views import VIEWS, look_through
from forbes.errors import ForbesError

if TYPE_CHECKING:
    from forbes.envs.known_process import Shown

__all__ = ["TASKS", "find_environment"]

_GYMNASIUM = "gymnasium:"
_PACKAGES = ("minigrid", "popgym")
"""Packages of environments that are extras of this one, and may therefore be imported by name."""
_HORIZONS = {"mountain_hike": 75, "multi_start_hike": 75, "t_maze": 30, "tiger": 30}
"""Steps per episode as in DVRL, in DPFRL, 3 L as in belief-rnn; that of the tiger is our choice."""

TASKS = f"""\
{", ".join(_HORIZONS)}: processes with an exact belief
memory_maze_SIZE: SIZE is {", ".join(SIZES)}; needs the extra memory-maze
{_GYMNASIUM}ID: any environment of Gymnasium; for a package that registers its own, with the package's name:
  {_GYMNASIUM}minigrid:MiniGrid-MemoryS7-v0, {_GYMNASIUM}popgym:popgym-RepeatPreviousEasy-v0;
  for a module of your own, also with --allow-module MODULE
CLASS: an Environment of your own, in a module named by --allow-module
other: a task of the DeepMind Control Suite as domain_task: cartpole_swingup, ball_in_cup_catch, walker_walk"""


def _open_process(task: str, shows: "Shown" = "observation") -> Environment:
    """Build the environment of a known process in its own process, so that torch is imported only there."""
    from forbes import pomdps
    from forbes.envs.known_process import KnownProcess

    processes: dict[str, Callable[[], pomdps.Process]] = {
        "mountain_hike": pomdps.MountainHike,
        "multi_start_hike": partial(pomdps.MountainHike, "multi", observation_std=1.5),
        "t_maze": pomdps.TMaze,
        "tiger": pomdps.Tiger,
    }
    return KnownProcess(processes[task](), _HORIZONS[task], shows)


_NAMED: dict[str, Callable[..., Environment]] = {
    **{name: partial(_open_process, name) for name in _HORIZONS},
    **{f"memory_maze_{size}": partial(MemoryMaze, size) for size in SIZES},
}
"""Environments of this package by name."""


def find_environment(task: str, **options: Any) -> Callable[[], Environment]:
    """Return a picklable function that makes the environment of a task.

    Args:
        task: name of the task, one of those in `TASKS`.
        options: arguments of the environment's constructor, and views (`VIEWS`), applied in this order; a view whose
            value is None is left out, and an argument of the constructor is no view.

    Raises:
        ForbesError: if there is no such task or option, or the task would import a module that is not allowed.

    Example:
        >>> make = forbes.find_environment("tiger")
        >>> make().reset(seed=0).observation.shape
        (2,)
    """
    external = {kind.__name__: kind for kind in _descendants(Environment) if not kind.__module__.startswith("forbes.")}
    make: Callable[..., Environment]
    if task in external:
        make = external[task]
    elif task in _NAMED:
        make = _NAMED[task]
    elif task.startswith(_GYMNASIUM):
        _require_known_module(task)
        make = partial(Gymnasium, task.removeprefix(_GYMNASIUM))
    elif near := difflib.get_close_matches(task, [*(external if "_" not in task else ()), *_NAMED], n=1, cutoff=0.8):
        raise ForbesError(f"{task}: no such task. Did you mean {near[0]}?")
    elif "_" not in task:  # every DOMAIN_TASK of DeepMind Control has one
        raise ForbesError(
            f"{task}: no such task. `forbes data collect --help` lists the tasks; an environment of your own needs "
            "--allow-module MODULE"
        )
    else:
        make = partial(DeepMindControl, task)
    known = inspect.signature(make).parameters.keys()
    views = {name: value for name, value in options.items() if name in VIEWS and name not in known}
    own = {name: value for name, value in options.items() if name not in views}
    if unknown := own.keys() - known:
        raise ForbesError(f"{task}: its environment has no option {min(unknown)}. Remove it")
    make, views = partial(make, **own), {name: value for name, value in views.items() if value is not None}
    return partial(look_through, make, views) if views else make


def _require_known_module(task: str) -> None:
    """Refuse `gymnasium:MODULE:ID` if Gymnasium would import an unknown module.

    A configuration may come from an untrusted source, and importing a module runs it. Known modules are those imported
    already, e.g. by --allow-module, packages that register environments by an entry point, and our extras.
    """
    module = task.removeprefix(_GYMNASIUM).rpartition(":")[0]
    if module in _PACKAGES and find_spec(module) is None:
        raise ForbesError(f"{task}: {module} is not installed. pip install 'forbes[{module}]'")
    registering = {entry.module.partition(".")[0] for entry in entry_points(group="gymnasium.envs")}
    if module and module not in {*sys.modules, *registering, *_PACKAGES}:
        raise ForbesError(
            f"{task}: {module} is not a package that registers environments. If you trust it, add: "
            f"--allow-module {module}"
        )


def _descendants(kind: type) -> Iterator[type]:
    children: list[type] = kind.__subclasses__()
    for child in children:
        yield child
        yield from _descendants(child)
