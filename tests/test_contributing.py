"""The recipes of CONTRIBUTING.md are followed word for word, in a copy of the repository."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import NamedTuple

import pytest

from forbes.commands.parsers import compare
from forbes.data.episodes.store import EpisodeStore
from forbes.evaluation.record import read_record
from forbes.runs.configs import find_config
from forbes.runs.folder import RunFolder

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
NEEDED = ("configs", "docs", "forbes", "tests")
PROGRAMS = ("forbes", "pytest")
"""Programs whose commands run in one process, after all edits; others make files."""

FOLLOW = """
import json, shlex, sys, traceback
import pytest
from forbes.commands.cli import main

if __name__ == "__main__":
    programs, statuses = {"forbes": main, "pytest": pytest.main}, {}
    for command in json.load(sys.stdin):
        program, *arguments = shlex.split(command)
        print("$", command, file=sys.stderr)
        statuses[command] = int(programs[program](arguments))
    json.dump(statuses, open("statuses.json", "w"))
"""


class Block(NamedTuple):
    """A block of a recipe: commands, or edits."""

    recipe: str
    kind: str
    text: str


def blocks():
    """All of them, in their order."""
    found = []
    for section in ("Introduction\n" + TEXT).split("\n## "):
        recipe, text = section.split("\n", 1)
        for _, kind, block in re.findall(r"^( *)```(\w+)\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE):
            found.append(Block(recipe, kind, textwrap.dedent(block)))
    return found


def commands_of(block):
    """The commands of a block: a line each, or a file that is written from `<<'END'` to `END`."""
    return re.findall(r"^.*<<'END'\n(?:.*\n)*?END$|^.+$", block.text, re.MULTILINE) if block.kind == "sh" else []


def commands(*programs):
    """The commands of all recipes that call one of these programs."""
    return [line for block in blocks() for line in commands_of(block) if line.split()[0] in programs]


def apply(edits, root):
    """Change the files that a block of edits names; each place must be there, once."""
    for edit in edits.split("@@ ")[1:]:
        name, *lines = edit.splitlines()
        before, after = ("".join(f"{line[1:]}\n" for line in lines if line[0] in signs) for signs in (" -", " +"))
        content = (root / name).read_text()
        assert content.count(before) == 1, f"{name} has this {content.count(before)} times:\n{before}"
        (root / name).write_text(content.replace(before, after))


def copy_repository(root):
    """Copy what the recipes need; the data, which none of them changes, stay where they are."""
    for name in NEEDED:
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    shutil.copy(ROOT / "pyproject.toml", root)
    (root / "data").symlink_to(ROOT / "data")


def test_every_file_that_a_recipe_names_exists():
    names = set(re.findall(r"`((?:forbes|tests|configs|docs)/[\w/]+(?:\.py|\.md)?)`", TEXT))

    assert len(names) >= 8
    assert not [name for name in names if not (ROOT / name).exists() and "room" not in name]


def test_every_recipe_works_word_for_word(in_tmp_path):
    copy_repository(in_tmp_path)
    for block in blocks():
        if block.kind == "diff":
            apply(block.text, in_tmp_path)
        for line in commands_of(block):
            if line.split()[0] not in PROGRAMS:
                subprocess.run(["bash", "-c", line], check=True)
    Path("follow.py").write_text(FOLLOW)

    subprocess.run(
        [sys.executable, "follow.py"],
        input=json.dumps(commands(*PROGRAMS)),
        env=os.environ | {"PYTHONPATH": str(in_tmp_path), "OMP_NUM_THREADS": "1"},
        text=True,
        check=True,
    )

    assert json.loads(Path("statuses.json").read_text()) == dict.fromkeys(commands(*PROGRAMS), 0)
    (family,) = Path("runs/strokes/yours").iterdir()
    for run, name in [(family, "YourBelief"), ("runs/your_model", "YourModel"), ("runs/your_source", "YourSource")]:
        assert f".{name}" in RunFolder(run).config.read_text()
    assert len(EpisodeStore("episodes/room").records) == 3
    assert "test[:10]/forward_kl[S=100]" in read_record("runs/your_process")
    assert "test[:20]/yours[categorical,K=128]" in read_record("runs/dry")
    assert Path("figures/yours.png").is_file()
    assert Path("figures/yours.pdf").is_file()
    assert Path("runs/your_picture/figures/yours.png").is_file()


def test_the_comparison_of_a_recipe_is_one_that_can_be_made(monkeypatch):
    monkeypatch.chdir(ROOT)
    (command,) = re.findall(r"`forbes compare ([^`]+)`", TEXT)

    *others, yours = compare.parser().parse_args(command.split()).configs

    assert [find_config(name).stem for name in others] == ["rssm", "forbes"]
    assert f"> configs/{yours}.yaml\n" in TEXT


def test_a_place_that_is_not_there_is_no_edit(tmp_path):
    (tmp_path / "a.py").write_text("one\ntwo\ntwo\n")

    apply("@@ a.py\n one\n+half\n", tmp_path)
    for place in (" three", " two"):
        with pytest.raises(AssertionError, match="times"):
            apply(f"@@ a.py\n{place}\n+more\n", tmp_path)

    assert (tmp_path / "a.py").read_text() == "one\nhalf\ntwo\ntwo\n"
