"""The pages say what is there: links lead somewhere, commands and their flags exist, the README's example runs."""

import argparse
import importlib
import re
from pathlib import Path

import lightning
import pytest

from forbes.commands.cli import COMMANDS
from forbes.commands.parsers.fit import DESCRIPTION

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [
    *ROOT.glob("*.md"),
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "benchmarks").glob("*.md"),
    *(ROOT / "data").rglob("*.md"),
    ROOT / "configs/README.md",
]
page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))


def anchor(heading):
    """The name by which GitHub links to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(path):
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)}


def commands(text):
    """The words of each `forbes` command of a page's indented blocks, without its comment."""
    joined = re.sub(r"\\\n\s+", "", text)
    return [
        line.split("  #")[0].split(" -- ")[0].split()
        for line in re.findall(r"^ {4,}forbes (.*)$", joined, re.MULTILINE)
    ]


def flags(parser):
    """The flags of a command and of those below it."""
    found = set()
    for action in parser._actions:
        found.update(action.option_strings)
        if isinstance(action, argparse._SubParsersAction):
            found.update(*map(flags, action.choices.values()))
    return found


@page
def test_every_link_leads_to_a_page_and_heading(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        name, _, heading = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if "://" not in target:
            assert path.exists(), target
            assert not heading or heading in anchors(path), target


@page
def test_every_command_and_flag_of_a_page_exists(page):
    for name, *words in commands(page.read_text()):
        used = {word.strip("[]").split("=")[0] for word in words if word.strip("[").startswith("-")}
        if name == "--help":
            continue
        assert name in COMMANDS, name
        if name not in DESCRIPTION:
            known = flags(importlib.import_module(f"forbes.commands.parsers.{name}").parser()) | {"--allow-module"}
            assert used <= known, (name, used - known)


def test_the_readme_is_read_in_two_minutes():
    assert len(README.splitlines()) <= 110
    assert max(map(len, README.splitlines())) <= 120


def test_the_readme_names_code_that_exists():
    for path in re.findall(r"`(forbes/[\w/]+\.py)`", README):
        assert (ROOT / path).exists(), path
    for name, path in re.findall(r"`(\w+(?:\.\w+)?)` in `(forbes/[\w/]+)\.py`", README):
        found = importlib.import_module(path.replace("/", "."))
        for part in name.split("."):
            found = getattr(found, part)


@pytest.mark.filterwarnings("ignore:.*LeafSpec", "ignore:.*does not have many workers", "ignore:.*IterableDataset")
def test_the_example_of_the_readme_runs(in_tmp_path, monkeypatch):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    trainer = lightning.Trainer
    monkeypatch.setattr(lightning, "Trainer", lambda max_epochs: trainer(fast_dev_run=True, accelerator="cpu"))
    names = {}

    exec(example, names)

    assert names["frames"].shape == (10, 8, 15, 1, 28, 28)
    assert names["future"].features.shape[:2] == (80, 15)
