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


def part_of(name):
    """Return the package, or the single module, that a full name belongs to."""
    return name.split(".")[1]


def name_of(path):
    return ".".join(["forbes", *path.relative_to(FORBES).with_suffix("").parts])


@pytest.fixture(scope="module")
def imports():
    """The full names that each module imports, anywhere in it, by the module's name."""
    found = {}
    for path in MODULES:
        names = found[name_of(path)] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_a_module_imports_nothing_from_its_right(imports):
    wrong = {}
    for module, names in imports.items():
        parts = {part_of(name) for name in names if name.startswith("forbes.") and not name.endswith("__")}
        wrong[module] = parts - {*LINE[: LINE.index(part_of(module)) + 1]}

    assert not {module: parts for module, parts in wrong.items() if parts}


def test_every_package_has_its_place_in_the_line(imports):
    assert {part_of(module) for module in imports} == {*LINE}


def test_evaluation_and_figures_do_not_know_the_trainer(imports):
    trainers = {
        module: {name.rpartition(".")[2] for name in names} & {"Trainer", "LightningCLI"}
        for module, names in imports.items()
        if part_of(module) in ("evaluation", "figures")
    }

    assert trainers
    assert not {module: found for module, found in trainers.items() if found}


def test_only_one_adapter_knows_the_known_processes(imports):
    knowing = {
        module
        for module, names in imports.items()
        if part_of(module) == "envs" and any(part_of(name) == "pomdps" for name in names if name.startswith("forbes."))
    }

    assert knowing == {"forbes.envs.known_process", "forbes.envs.tasks"}


def test_a_module_can_be_read_in_one_sitting():
    assert not [name_of(path) for path in MODULES if len(path.read_text().splitlines()) > 350]


def test_no_module_unpickles(imports):
    packages = {module: {name.split(".")[0] for name in names} for module, names in imports.items()}
    assert not [module for module in packages if packages[module] & {"dill", "cloudpickle", "marshal", "shelve"}]

    words = ("weights_only=False", "allow_pickle=True", "pickle.load")
    assert not [name_of(path) for path in MODULES if any(word in path.read_text() for word in words)]
