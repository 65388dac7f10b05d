"""Names of runs by their config.yaml: the method, and the task or data. Nothing heavy is imported."""

import re
from pathlib import Path
from typing import Any

__all__ = ["class_of", "method_of", "part_of", "task_of", "with_suffix", "without_seed"]

_GAUSSIAN = {"WorldModel": "RSSM", "ImaginationActorCritic": "Dreamer", "PlanningAgent": "PlaNet"}
"""Published names of what learns a Gaussian belief, by its class."""
_SHOWN = {"exact_belief": "exact belief", "nothing": "no observation"}
"""Names of agents that observe something else than the observation."""


def with_suffix(method: str, path: str) -> str:
    """Append the suffix of the experiment's name in a run's path: RSSM wide for `runs/rssm_wide-0`."""
    for part in reversed(Path(path).resolve().parts):
        if match := re.search(rf"(?<![a-z]){method}((?:_[a-z]+)+)(?![a-z\d])", part, re.IGNORECASE):
            return method + match[1].replace("_", " ")
    return method


def without_seed(section: dict[str, Any]) -> dict[str, Any]:
    """Return a section of a configuration without its seed."""
    arguments = {name: value for name, value in section.get("init_args", {}).items() if name != "seed"}
    return section | {"init_args": arguments}


def method_of(config: dict[str, Any]) -> str:
    """Return the published name of an agent or world model."""
    arguments = config["model"]["init_args"]
    shown = part_of(part_of(config["data"]["init_args"], "source", "init_args"), "options").get("shows")
    if shown in _SHOWN:
        return _SHOWN[shown]
    kind = class_of(part_of(arguments, "model"))
    if kind not in ("", "StateSpaceModel"):
        return kind.removesuffix("Model")
    posterior, prior = (class_of(part_of(arguments, name)) for name in ("belief", "prior"))
    belief = prior if prior and posterior == "GaussianBelief" else posterior  # FORBES may have a flow in one only
    if belief == "GaussianBelief":
        return _GAUSSIAN.get(learner := class_of(config["model"]), learner)
    if belief == "CategoricalBelief" and arguments.get("two_hot"):
        return "DreamerV3"
    return "FORBES" if belief == "FlowBelief" else belief.removesuffix("Belief")


def task_of(arguments: dict[str, Any]) -> str:
    """Return the task of an agent, or the name of a world model's data."""
    source = part_of(arguments, "source")
    options = part_of(source, "init_args")
    if "task" in options:
        return str(options["task"])
    path = options.get("path")
    return Path(path).name.removesuffix(".npz") if path else class_of(source)


def part_of(section: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return a nested section, empty if it is not there."""
    for name in names:
        found = section.get(name)
        section = found if isinstance(found, dict) else {}
    return section


def class_of(section: dict[str, Any]) -> str:
    """Return the name of a class in a configuration, without its module."""
    return str(section.get("class_path", "")).rpartition(".")[2]
