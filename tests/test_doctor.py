"""The doctor finds what is missing, and says what to do."""

import pytest

from forbes.cli import main
from forbes.envs.rendering import Probe

PROBES = {"egl": Probe("egl", "llvmpipe (LLVM 15)", 37.6), "osmesa": Probe("osmesa", problem="no libOSMesa")}


@pytest.fixture(autouse=True)
def probes(monkeypatch):
    """What rendering gives is told, not tried: `tests/envs` tries it."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("forbes.doctor.probe_backend", lambda name: PROBES.get(name, Probe(name, problem="unknown")))


def test_a_machine_that_can_train_is_well(capsys):
    assert main(["doctor"]) == 0

    output = capsys.readouterr().out
    for word in ("torch", "processors", "free disk", "configurations", "strokes, bundled"):
        assert word in output


def test_missing_data_are_named_with_their_remedy(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("forbes.doctor.bundled_path", lambda: tmp_path / "strokes.npz")

    assert main(["doctor"]) == 1

    assert "forbes data build-strokes" in capsys.readouterr().out


@pytest.mark.parametrize("argument", ["surplus", "--unknown"])
def test_the_doctor_takes_no_arguments(argument, capsys):
    assert main(["doctor", argument]) == 2

    assert f"unrecognized arguments: {argument}" in capsys.readouterr().err


def test_backends_are_tried_and_a_broken_one_has_its_remedy(capsys, monkeypatch):
    pytest.importorskip("dm_control")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("MUJOCO_GL", "wgl")

    assert main(["doctor"]) == 0

    lines = capsys.readouterr().out.splitlines()
    found = {name: next(line for line in lines if f"rendering, {name}" in line) for name in ("egl", "osmesa", "wgl")}
    assert "llvmpipe (LLVM 15), 38 frames of 64 x 64 a second" in found["egl"]
    assert "no libOSMesa" in found["osmesa"]
    assert "apt-get install libosmesa6" in found["osmesa"]
    assert "unset MUJOCO_GL" in found["wgl"]
