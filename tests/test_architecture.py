"""The packages stand in a line, and nothing imports from its right."""

import ast
from pathlib import Path

import pytest

FORBES = Path(__file__).parents[1] / "forbes"
MODULES = sorted(FORBES.rglob("*.py"))

FOUNDATION = [
    "errors",
    "factors",
    "bundled",
    "files",
    "reading",
    "child",
    "choices",
    "configured",
    "densities",
    "frozen",
    "named",
    "rounding",
    "distributed",
]
FOUNDATION += ["seeding", "shapes", "signatures", "symlog"]
PACKAGES = ["performance", "beliefs", "models", "control", "pomdps", "envs", "data", "runs", "training", "evaluation"]
PACKAGES += ["figures", "callbacks", "commands"]
LINE = [*FOUNDATION, *PACKAGES, "__main__", "__init__"]


def imports_of(path):
    """Return the full names that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(name):
    """Return the package, or the single module, that a full name belongs to."""
    return name.split(".")[1]


def name_of(path):
    return ".".join(["forbes", *path.relative_to(FORBES).with_suffix("").parts])


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_module_imports_nothing_from_its_right(path):
    parts = {part_of(name) for name in imports_of(path) if name.startswith("forbes.") and not name.endswith("__")}

    assert parts <= {*LINE[: LINE.index(part_of(name_of(path))) + 1]}


def test_every_package_has_its_place_in_the_line():
    assert {part_of(name_of(path)) for path in MODULES} == {*LINE}


@pytest.mark.parametrize("path", [p for p in MODULES if part_of(name_of(p)) in ("evaluation", "figures")], ids=name_of)
def test_evaluation_and_figures_do_not_know_the_trainer(path):
    assert not {name.rpartition(".")[2] for name in imports_of(path)} & {"Trainer", "LightningCLI"}


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
