"""The pages say what is there: links lead somewhere, commands and their flags exist, the README's example runs."""

import argparse
import importlib
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import lightning
import pytest
import small_agents

import forbes
from forbes.commands.cli import COMMANDS, main
from forbes.commands.parsers.fit import DESCRIPTION

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [
    *ROOT.glob("*.md"),
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "benchmarks").glob("*.md"),
    *(ROOT / "data").rglob("*.md"),
    ROOT / "configs/README.md",
    *(ROOT / "notebooks").glob("*.ipynb"),
]
page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))


def anchor(heading):
    """The name by which GitHub links to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def text_of(page):
    """The text of a page, or of the cells of a notebook that are not code."""
    if page.suffix != ".ipynb":
        return page.read_text()
    cells = json.loads(page.read_text())["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def anchors(path):
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)$", text_of(path), re.MULTILINE)}


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
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        name, _, heading = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if "://" not in target:
            assert path.exists(), target
            assert not heading or heading in anchors(path), target


@page
def test_every_command_and_flag_of_a_page_exists(page):
    for name, *words in commands(text_of(page)):
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


EQUATIONS = re.findall(
    r"\{literalinclude\} \.\./(\S+)\n:pyobject: (\S+)\n:start-at: '(.*)'\n:end-at: '(.*)'",
    (ROOT / "docs/equations.md").read_text(),
)


@pytest.mark.parametrize(("path", "name", "first", "last"), EQUATIONS, ids=[name for _, name, *_ in EQUATIONS])
def test_an_equation_quotes_lines_of_its_function(path, name, first, last):
    found = importlib.import_module(path.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        found = getattr(found, part)
    source = inspect.getsource(found.fget if isinstance(found, property) else inspect.unwrap(found))

    assert inspect.getsourcefile(inspect.unwrap(getattr(found, "fget", found))) == str(ROOT / path)
    body = source[source.index('"""', source.index('"""') + 3) :]  # the code, not the docstring
    assert first in body
    assert last in body[body.index(first) :]


def test_every_equation_of_the_table_has_its_lines():
    text = (ROOT / "docs/equations.md").read_text()
    rows = re.findall(r"^\| \[(.*?)\]\(#.*?\) \|.*\| `(\S+)` in `(\S+)` \|$", text, re.MULTILINE)

    assert [heading for heading, *_ in rows] == re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert [(path, name) for _, name, path in rows] == [(path, name) for path, name, *_ in EQUATIONS]


def test_the_reference_has_every_public_name():
    text = (ROOT / "docs/reference.md").read_text()
    listed = re.findall(r"^   (\w+)$", text, re.MULTILINE)

    assert sorted(listed) == sorted(forbes.MODULES)
    for module, name in re.findall(r"^   (\w+)\.(\w+)$", text, re.MULTILINE):
        assert hasattr(importlib.import_module(f"forbes.{module}"), name), name


def described(page):
    """Patterns of the names in the first columns of a page's tables; words in capitals stand for anything."""
    names = re.findall(r"^\| `([^`]+)` \|", page.read_text(), re.MULTILINE)
    return {name: re.compile(re.sub(r"\\?[A-Z]+", "[^/]+", re.escape(name)) + "$") for name in names}


def recorded(run):
    """Names in the records of a run, but for the counters of a line."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    evaluation = run / "evaluation.json"
    names = {name for line in lines for name in line} | set(json.loads(evaluation.read_text()))
    return names - {"update", "epoch", "start"}


WORLDS = {
    "flow": (["--trainer.callbacks+=ParameterCount"], ["elbo", "pll", "fivo", "open-loop"]),
    "particles": (["--model.model", "ParticleModel"], ["pll"]),
    "vector": (["--model.model", "VectorModel", "--model.state_dim", "0"], ["pll", "open-loop"]),
}
RARE = {"divergence/update", "divergence/RATE", "reward_uncertainty[episodes=N]"}
RARE |= {"SPLIT/reconstruction/PART", "SPLIT/reconstruction/PART[LIKELIHOOD,S=N]"}  # see commands/test_parts.py
"""Metrics that the small runs above do not record."""
PROCESS = ["--trainer.max_epochs", "1", "--data.updates_per_epoch", "2", "--data.validation_sequences", "4"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*does not predict termination", "ignore:.*does not have many workers")
def test_every_recorded_number_is_explained(tiny_config, tmp_path, monkeypatch):
    def run(*arguments):
        assert main([str(argument) for argument in arguments]) == 0

    monkeypatch.chdir(tmp_path)
    for name, (options, scores) in WORLDS.items():
        run("fit", "--config", tiny_config, *options, "--run_dir", name)
        run("evaluate", name, "--sequences", 4, "--particles", 8, "--futures", 2, "--context", 2, "--scores", *scores)
    folder = ROOT / "configs/pomdp/mirror_sensor"
    run("fit", "--config", folder / "known_mixture.yaml", *PROCESS, "--run_dir", "known")
    run("beliefs", "known", "--sequences", 2, "--samples", 2)
    run("fit", "--config", folder / "forbes.yaml", *PROCESS, "--run_dir", "process")
    run("evaluate", "process", "--sequences", 2, "--particles", 2, "--scores", "elbo")
    small_agents.fit(
        "--config", small_agents.write_config(tmp_path), "--model.continuation", "true", "--run_dir", "agent"
    )
    small_agents.forbes("evaluate", "agent", "--episodes", 2)
    found = set().union(*(recorded(tmp_path / name) for name in (*WORLDS, "known", "process", "agent")))

    patterns = described(ROOT / "docs/metrics.md")
    assert not [name for name in sorted(found) if not any(pattern.match(name) for pattern in patterns.values())]
    unseen = {name for name, pattern in patterns.items() if not any(map(pattern.match, found))}
    assert {name for name in unseen if "/" in name or "[" in name} == RARE  # others are of `completions.json`


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", ROOT / "docs", ROOT, tmp_path],
        capture_output=True,
        text=True,
    )

    assert built.returncode == 0, built.stderr
    assert (tmp_path / "index.html").exists()
    page = (tmp_path / "docs/equations.html").read_text()
    assert "<math" in page
    assert not re.search(r"(src|href)=\"https?://[^\"]*\.(js|css)", page)  # it is read without a network, too
