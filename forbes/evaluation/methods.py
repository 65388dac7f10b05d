"""Runs as they are recorded: their method and task from config.yaml, their curves from metrics.jsonl.

No model is loaded, so runs can be drawn while they train, or where their checkpoint is missing.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from forbes.errors import ForbesError
from forbes.runs.folder import RunFolder, read_config, read_metrics
from forbes.runs.naming import class_of, method_of, part_of, task_of, with_suffix, without_seed

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["LAYERS", "TRAJECTORIES", "RecordedRun", "by_configuration", "group_by_method", "read_run", "returns_of"]

TRAJECTORIES, LAYERS = "trajectories", "mlp_layers"
_SETTINGS = {TRAJECTORIES: "N = {}", LAYERS: "{} layers"}
"""Settings that the paper varies, and how they are written."""


class RecordedRun(NamedTuple):
    """A run folder, without its model."""

    path: str
    """Path as the user typed it."""
    method: str
    """Published name of the agent or world model with the suffix of the experiment's, e.g. Dreamer or RSSM wide."""
    task: str
    """Task of an agent; for others the name of the folder or class of their data."""
    settings: dict[str, Any]
    """Those of N (`trajectories`) and `mlp_layers` that its configuration has."""
    config: dict[str, Any]
    """Sections `model` and `data` of config.yaml without seeds: equal for runs that differ only in the seed."""

    @property
    def source(self) -> str:
        """Class of the source of its data."""
        return class_of(part_of(self.config, "data", "init_args", "source"))


def read_run(path: str) -> RecordedRun:
    """Read the configuration of a run.

    Raises:
        ForbesError: if it is missing or damaged.
    """
    file = RunFolder(path).config
    if not file.is_file():
        raise ForbesError(f"{path}: not a run folder, config.yaml is missing. Name a folder written by `forbes fit`")
    found = read_config(file)
    config = {name: without_seed(found[name]) for name in ("model", "data")}
    arguments = config["model"]["init_args"]
    settings = {name: arguments[name] for name in _SETTINGS if name in arguments}
    method = with_suffix(method_of(config), path)
    return RecordedRun(path, method, task_of(config["data"]["init_args"]), settings, config)


class _HasConfiguration(Protocol):
    @property
    def config(self) -> Mapping[str, Any]: ...


Run = TypeVar("Run", bound=_HasConfiguration)


def by_configuration(runs: Sequence[Run]) -> list[list[Run]]:
    """Group runs whose configurations differ only in the seed. Groups and their runs keep the order of the runs."""
    groups: list[list[Run]] = []
    for run in runs:
        same = next((others for others in groups if others[0].config == run.config), None)
        if same is None:
            groups.append([run])
        else:
            same.append(run)
    return groups


def group_by_method(
    runs: Sequence[RecordedRun], always: Collection[str] = ()
) -> dict[str, dict[str, list[RecordedRun]]]:
    """Group runs whose configurations differ only in the seed: runs by task and title, in the order of the runs.

    The title is the method with the settings in which its runs differ, e.g. `Dreamer, N = 4`. If two configurations of
    a task would share a title, the name of their folder is appended, or its whole path.

    Args:
        runs: runs of any tasks.
        always: settings that are always in the title, e.g. `trajectories`.
    """
    of_tasks: dict[str, list[list[RecordedRun]]] = {}
    for members in by_configuration(runs):
        of_tasks.setdefault(members[0].task, []).append(members)
    grouped: dict[str, dict[str, list[RecordedRun]]] = {}
    for task, of_task in of_tasks.items():
        grouped[task] = dict(zip(_titles([of_one[0] for of_one in of_task], runs, always), of_task, strict=True))
    return grouped


def _titles(firsts: Sequence[RecordedRun], runs: Sequence[RecordedRun], always: Collection[str]) -> list[str]:
    """Return a different title for each configuration of a task, given its first run."""
    plain = [_title(run, runs, always) for run in firsts]
    titles = plain
    for name in (_folder, str):
        titles = [
            title if titles.count(title) == 1 else f"{short} ({name(run.path)})"
            for title, short, run in zip(titles, plain, firsts, strict=True)
        ]
    return titles


def _title(run: RecordedRun, runs: Sequence[RecordedRun], always: Collection[str]) -> str:
    same = [other for other in runs if other.method == run.method]
    shown = [
        text.format(run.settings[name])
        for name, text in _SETTINGS.items()
        if name in run.settings and (name in always or len({other.settings.get(name) for other in same}) > 1)
    ]
    return ", ".join([run.method, *shown])


def _folder(path: str) -> str:
    """Return the name that the folders of one configuration share: that of the experiment, without the seed."""
    folder = RunFolder(path).path.absolute()
    return folder.parent.name if re.match(r"\d{8}-\d{6}-", folder.name) else re.sub(r"-\d+$", "", folder.name)


def returns_of(run: RecordedRun) -> "pd.Series":
    """Return the returns of an agent without exploration, indexed by env steps.

    Raises:
        ForbesError: if none was measured.
    """
    table = read_metrics(run.path)
    if not {"env_steps", "return/acting"} <= {*table}:
        raise ForbesError(f"{run.path}: metrics.jsonl has no return/acting. Name runs of agents with measured returns")
    return table[["env_steps", "return/acting"]].dropna().set_index("env_steps")["return/acting"]
