"""A list of trainings, and how it is worked off: each in its own process, resumed where it was interrupted."""

import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from forbes.commands.jobs import Ended, Job
from forbes.errors import ForbesError
from forbes.runs.configuration import allowed_modules
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.provenance import read_provenance

__all__ = ["Training", "complete_configuration", "failures", "forbes_command", "is_finished", "not_finished"]
__all__ += ["require_trainable", "training_job", "unfinished_jobs"]

_SEEDS = ("seed_everything", "model.init_args.seed", "data.init_args.seed")  # the first is linked to the others


class Training(NamedTuple):
    """One training."""

    config: str
    """Configuration, as `forbes fit --config` accepts it."""
    flags: tuple[str, ...]
    """Flags that override keys of the configuration."""
    seed: int
    folder: str
    """Run folder."""


def training_job(training: Training, hours: float = 1.0) -> Job:
    """Return the `forbes fit` that starts a training, or resumes it from its checkpoint.

    It is refused if the folder has a run of another configuration.

    Args:
        training: training to run to its end.
        hours: how long it takes, relative to the other jobs.
    """
    config, flags, seed, folder = training
    refused = ""
    if RunFolder(folder).checkpoint.exists():
        try:
            _require_same_configuration(training)
        except ForbesError as error:
            refused = str(error)
    arguments = ["--config", config, *flags, "--seed_everything", str(seed), "--run_dir", folder]
    resume = forbes_command("fit", "--resume", folder)
    return Job(folder, forbes_command("fit", *arguments), hours, folder, resume, refused)


def unfinished_jobs(trainings: Sequence[Training]) -> list[Job]:
    """Return the jobs of the trainings that are not finished, and of those whose folder has another configuration."""
    return [job for job in map(training_job, trainings) if job.refused or not is_finished(job.run)]


def is_finished(folder: str) -> bool:
    """Return whether the last training in a run folder came to its end."""
    run = RunFolder(folder)
    if not (run.checkpoint.is_file() and run.provenance.is_file()):
        return False
    entries = read_provenance(run.provenance)
    return bool(entries) and entries[-1].get("exit_status") == 0


def failures(ended: Sequence[Ended]) -> dict[str, str]:
    """Print a line for each job that is not finished, and return the reasons by name."""
    reasons = {one.job.name: one.reason for one in ended if one.status != 0}
    for name, reason in reasons.items():
        print(f"not finished: {name} {reason}", flush=True)
    return reasons


def not_finished(failed: Mapping[str, str], total: int) -> ForbesError:
    """Return the error for trainings whose reasons have been printed."""
    names = ", ".join(failed)
    return ForbesError(
        f"{len(failed)} of {total} trainings are not finished, for the reasons above: {names}. "
        "Fix them, then repeat the command"
    )


def require_trainable(config: str, flags: Sequence[str]) -> None:
    """Check the keys and values of a configuration.

    Raises:
        ForbesError: the error of `forbes fit`.
    """
    complete_configuration(config, *flags)


def forbes_command(*arguments: str) -> list[str]:
    """Return a `forbes ...` in its own process, so that one does not affect another: arguments of Python."""
    return ["-m", "forbes", *allowed_modules(), *arguments]


def _require_same_configuration(training: Training) -> None:
    """Refuse a run that was trained with another configuration, e.g. with fewer updates.

    Our callbacks that only observe may differ. Keys that the run's version of this package did not have are ignored.
    """
    config, flags, seed, run = training
    trained = _comparable(read_config(RunFolder(run).config))
    asked = _comparable(yaml.safe_load(complete_configuration(config, *flags))) | {key: seed for key in _SEEDS}
    for key in asked:
        if key in trained and trained[key] != asked[key]:
            raise ForbesError(
                f"{run}: was trained with {key} = {trained[key]}, expected {asked[key]}. Use its configuration and "
                "flags, or another folder, -o"
            )


def _comparable(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return every value of a configuration by its dotted key, with absolute paths, without callbacks that observe."""
    found = _flat(config)
    callbacks = found.pop("trainer.callbacks", None) or []
    listed = callbacks if isinstance(callbacks, list) else [callbacks]
    acting = {name: one for one in listed if (name := one["class_path"].rpartition(".")[2]) not in _observing()}
    found |= {"trainer.callbacks": sorted(acting)}
    for name, one in acting.items():
        found |= _flat(one.get("init_args") or {}, f"trainer.callbacks.{name}")
    return found | {key: str(Path(found[key]).absolute()) for key in found if key.endswith(".path") and found[key]}


@cache
def _observing() -> frozenset[str]:
    """Return the names of our callbacks that do not change a training."""
    import forbes.callbacks as ours  # imports Lightning, which only a folder with runs needs
    from forbes.callbacks.picture import FileCallback

    kinds = [getattr(ours, name) for name in ours.__all__]
    return frozenset(kind.__name__ for kind in kinds if issubclass(kind, FileCallback | ours.ParameterCount))


def _flat(section: Any, name: str = "") -> dict[str, Any]:
    """Flatten a nested section: every value by its dotted key, e.g. `model.init_args.state_dim`."""
    if not isinstance(section, dict):
        return {name: section}
    return {k: v for key, value in section.items() for k, v in _flat(value, f"{name}.{key}".strip(".")).items()}


@cache
def complete_configuration(config: str, *flags: str) -> str:
    """Return the complete configuration that `forbes fit` would train with, as YAML."""
    command = forbes_command("fit", "--config", config, *flags, "--print_config")
    asked = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False)
    if asked.returncode != 0:
        *_, last = asked.stderr.splitlines() or [f"{config}: `forbes fit` ended with status {asked.returncode}"]
        raise ForbesError(last.removeprefix("forbes: "))
    return asked.stdout
