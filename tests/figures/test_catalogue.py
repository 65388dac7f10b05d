"""`forbes figures`: the table of the paper's figures, and how one of them is named."""

import importlib
import inspect
import subprocess
import sys

import pytest
from command_line import error_of

from forbes.commands.cli import main
from forbes.commands.parsers.figures import OPTIONS
from forbes.errors import ForbesError
from forbes.figures.catalogue import FIGURES, draw, find_figure


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: figure.name)
def test_every_figure_has_its_function_and_options(figure):
    module, function = figure.target.split(":")
    drawn = getattr(importlib.import_module(f"forbes.figures.{module}"), function)

    parameters = inspect.signature(drawn).parameters
    assert next(iter(parameters)) == "runs"
    assert {*parameters} - {"runs"} == {*figure.options}
    assert {*figure.options} <= {*OPTIONS}
    assert all(parameters[option].default is not inspect.Parameter.empty for option in figure.options)


def test_the_list_has_all_figures_in_80_columns_and_is_light():
    program = """
import sys
from forbes.commands.cli import main
assert main(["figures", "list"]) == 0
assert not {"torch", "matplotlib", "pandas"} & sys.modules.keys()
"""
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout

    assert max(map(len, told.splitlines())) <= 80
    for figure in FIGURES:
        assert f" {figure.name} " in told


def test_names_and_numbers_are_found_once():
    names = [figure.name for figure in FIGURES]
    numbers = [figure.number for figure in FIGURES if figure.number.isdigit()]
    assert len({*names, *numbers}) == len(names) + len(numbers)
    assert find_figure("4") == find_figure("predictions")
    for name in ("appendix", "ours", "strokes"):
        with pytest.raises(ForbesError, match=f"{name}: no such figure"):
            find_figure(name)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["predictons", "--runs", "a"], "predictons: no such figure. Did you mean predictions?"),
        (["9", "--runs", "a"], "9: no such figure. There are "),
        (["elbo"], "forbes figures elbo: no runs to draw. Name some: --runs RUN"),
        (["elbo", "--runs", "a", "--index", "3"], "--index: is an option of beliefs"),
        (["list", "--runs", "a"], "forbes figures list: it draws nothing, so it has no options"),
        ([], "forbes figures: the following arguments are required: NAME. See forbes figures --help"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence(arguments, sentence, capsys):
    assert error_of(capsys, "figures", *arguments).startswith(sentence)


def test_a_figure_is_drawn_from_python_as_from_the_command_line(tiny_run, tmp_path, capsys):
    paths = draw("elbo", [str(tiny_run)], tmp_path / "python")
    assert main(["figures", "5", "--runs", str(tiny_run), "-o", str(tmp_path / "shell")]) == 0

    assert [path.name for path in paths] == ["elbo.png", "elbo.pdf"]
    assert capsys.readouterr().out.split() == [str(tmp_path / "shell" / path.name) for path in paths]
    for path in paths:
        assert path.read_bytes() == (tmp_path / "shell" / path.name).read_bytes()
