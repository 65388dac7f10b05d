"""The options of the launchers: what is not used is refused, what is missing is said."""

import sys

import pytest
from command_line import error_of


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--address", "a:1"], "--address: is for --launcher ray, not local. Change one of them"),
        (["--launcher", "slurm", "--gpus-per-job", "1"], "--gpus-per-job: is for --launcher ray, not slurm"),
        (["--launcher", "ray", "--slurm", "time=1"], "--slurm: is for --launcher slurm, not ray"),
        (["--launcher", "ray", "--gpus-per-job", "1.5"], "1.5 is not a number of GPUs, e.g. 0.25, 1 or 2"),
        (["--launcher", "pbs"], "invalid choice: 'pbs'"),
    ],
)
@pytest.mark.parametrize("command", [["compare", "strokes/forbes"], ["reproduce"]], ids=lambda command: command[0])
def test_an_option_that_is_not_used_is_refused(command, options, sentence, tmp_path, capsys):
    assert sentence in error_of(capsys, *command, *options, "-o", tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("launcher", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_missing_package_is_named(launcher, package, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)

    error = error_of(capsys, "compare", "strokes/forbes", "--launcher", launcher, "-o", tmp_path)

    assert error == f"--launcher {launcher}: {package} is not installed. pip install 'forbes[{launcher}]'"
