"""Configurations by name: from any folder, in any order of words, and the nearest names for a wrong one."""

import re
from pathlib import Path

import pytest

from forbes.errors import ForbesError
from forbes.runs.configs import config_folder, find_config, shipped_configs, with_config_paths

CONFIGS = Path(__file__).parents[2] / "configs"


def test_every_file_of_the_folder_has_its_name():
    assert config_folder() == CONFIGS
    assert set(shipped_configs().values()) == set(CONFIGS.rglob("*.yaml"))
    assert all(CONFIGS / f"{name}.yaml" == path for name, path in shipped_configs().items())


def test_the_configurations_of_a_wheel_are_inside_the_package(tmp_path, monkeypatch):
    package = tmp_path / "forbes"
    (package / "configs" / "strokes").mkdir(parents=True)
    file = package / "configs" / "strokes" / "only.yaml"
    file.write_text("")
    monkeypatch.setattr("forbes.bundled.__file__", str(package / "bundled.py"))

    assert shipped_configs() == {"strokes/only": file}
    assert find_config("strokes/only") == file


def test_a_file_is_preferred_to_a_name_and_a_folder_is_not(in_tmp_path):
    Path("debug").write_text("model: {}")
    Path("strokes/forbes").mkdir(parents=True)  # as in runs/

    assert find_config("debug") == Path("debug")
    assert find_config("strokes/forbes") == CONFIGS / "strokes/forbes.yaml"


@pytest.mark.parametrize(
    "arguments",
    [
        ["strokes/forbes", "debug", "--trainer.max_epochs", "3"],
        ["--config", "strokes/forbes", "-c", "debug", "--trainer.max_epochs", "3"],
        ["strokes/forbes", "--config=debug", "--trainer.max_epochs", "3"],
        [str(CONFIGS / "strokes/forbes.yaml"), "debug", "--trainer.max_epochs", "3"],
    ],
)
def test_a_configuration_may_be_given_in_several_ways(arguments, in_tmp_path):
    paths = [str(CONFIGS / f"{name}.yaml") for name in ("strokes/forbes", "debug")]

    assert with_config_paths(arguments) == ["--config", paths[0], "--config", paths[1], "--trainer.max_epochs", "3"]


def test_values_of_other_flags_are_no_configurations(in_tmp_path):
    arguments = ["--model.kl", "debug", "--model.center", "strokes/forbes", "--config"]

    assert with_config_paths(arguments) == arguments


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("strokes/forbs", "strokes/forbs: no such configuration. Did you mean strokes/forbes, "),
        ("rssm_wide", "Did you mean strokes/rssm_wide, "),
        ("configs/strokes/forbes.yaml", "Did you mean strokes/forbes? List all: forbes configs"),
        ("./configs/debug.yaml", "Did you mean debug?"),
        ("quite_another", "quite_another: no such configuration. List all: forbes configs"),
    ],
)
def test_a_wrong_name_is_told_with_the_nearest_ones(name, expected, in_tmp_path):
    with pytest.raises(ForbesError, match=f"{re.escape(name)}: no such configuration") as error:
        find_config(name)

    assert expected in str(error.value)


@pytest.mark.parametrize("name", shipped_configs())
def test_the_command_in_a_configuration_is_one_for_it(name):
    comment = [line for line in shipped_configs()[name].read_text().splitlines() if line.startswith("#")]
    (command,) = [line.removeprefix("# forbes fit ") for line in comment if line.startswith("# forbes fit ")]

    found = with_config_paths(command.split())

    assert str(shipped_configs()[name]) in found
