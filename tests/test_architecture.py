"""The house keeps its arrows: data flows left to right, and nothing imports from its right (DESIGN §2)."""

import ast
from pathlib import Path

import pytest

FORBES = Path(__file__).parents[1] / "forbes"
MODULES = sorted(FORBES.rglob("*.py"))

FOUNDATION = {
    "child",
    "errors",
    "files",
    "seeding",
    "arguments",
    "configured",
    "deferred",
    "frozen",
    "fusion",
    "named",
    "precision",
}
FOUNDATION |= {"parsers", "reading", "shapes", "signatures"}
BENEATH = {"beliefs", "data", "envs", "models", "control", "pomdps"}  # what training knows
MAY_IMPORT = {  # besides itself and the foundation
    **{part: set() for part in (*FOUNDATION, "beliefs", "pomdps")},
    "envs": {"pomdps"},  # the adapter that makes an environment of a process
    "data": {"pomdps", "envs"},  # processes and played episodes are where sequences come from
    "models": {"beliefs"},
    "control": {"beliefs", "models"},
    "training": BENEATH | {"training.callbacks"},
    "training.callbacks": BENEATH | {"training", "evaluation", "figures"},
    "evaluation": BENEATH | {"training"},
    "figures": BENEATH | {"training", "evaluation"},
    "doctor": {"data", "envs"},
    "parsers": {"envs"},  # names of tasks; nothing that imports torch
    "cli": set(),
    "__main__": {"cli"},
    "__init__": BENEATH | {"training", "evaluation"},  # the Python API, imported when it is asked for
}


def imports_of(path):
    """Give the full names that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(name):
    """Give the part of the house that a full name belongs to."""
    _, *parts = name.split(".")
    return "training.callbacks" if parts[:2] == ["training", "callbacks"] else parts[0]


def name_of(path):
    return ".".join(["forbes", *path.relative_to(FORBES).with_suffix("").parts])


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_module_imports_nothing_from_its_right(path):
    part = part_of(name_of(path))
    parts = {part_of(name) for name in imports_of(path) if name.startswith("forbes.") and not name.endswith("__")}

    assert parts <= MAY_IMPORT[part] | FOUNDATION | {part}


@pytest.mark.parametrize("path", [p for p in MODULES if part_of(name_of(p)) in ("evaluation", "figures")], ids=name_of)
def test_evaluation_and_figures_do_not_know_the_trainer(path):
    assert not {name.rpartition(".")[2] for name in imports_of(path)} & {"Trainer", "LightningCLI"}
    assert "forbes.training.commands" not in {name.rpartition(".")[0] for name in imports_of(path)}


@pytest.mark.parametrize("path", [p for p in MODULES if part_of(name_of(p)) == "envs"], ids=name_of)
def test_only_one_adapter_knows_the_known_processes(path):
    parts = {part_of(name) for name in imports_of(path) if name.startswith("forbes.")}

    assert "pomdps" not in parts or path.stem in ("known_process", "tasks")


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_module_can_be_read_in_one_sitting(path):
    assert len(path.read_text().splitlines()) <= 350


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_no_module_unpickles(path):
    assert not {name.split(".")[0] for name in imports_of(path)} & {"dill", "cloudpickle", "marshal", "shelve"}
    text = path.read_text()
    assert not [word for word in ("weights_only=False", "allow_pickle=True", "pickle.load") if word in text]
