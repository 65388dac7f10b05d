"""The doctor finds what is missing, and says what to do."""

import re
from types import SimpleNamespace

import pytest
import torch

from forbes.commands.cli import main
from forbes.envs.rendering import Probe

PROBES = {"egl": Probe("egl", "llvmpipe (LLVM 15)", 37.6), "osmesa": Probe("osmesa", problem="no libOSMesa")}


@pytest.fixture(autouse=True)
def probes(monkeypatch):
    """What rendering gives is told, not tried: `tests/envs` tries it."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(
        "forbes.commands.doctor.probe_backend", lambda name: PROBES.get(name, Probe(name, problem="unknown"))
    )


def test_a_machine_that_can_train_is_well(capsys):
    assert main(["doctor"]) == 0

    output = capsys.readouterr().out
    for word in ("torch", "CPUs", "free disk", "configurations", "strokes, bundled"):
        assert word in output


def test_a_missing_package_is_named_with_its_remedy(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("forbes.commands.doctor.REQUIRED", ("torch", "no-such-package"))

    assert main(["doctor"]) == 1

    assert re.search(r"no-such-package +not installed +pip install no-such-package", capsys.readouterr().out)


def test_missing_data_are_named_with_their_remedy(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("forbes.commands.doctor.bundled_path", lambda: tmp_path / "strokes.npz")

    assert main(["doctor"]) == 1

    assert "forbes data build-strokes" in capsys.readouterr().out


def test_every_gpu_and_the_driver_are_named(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda n: SimpleNamespace(name="H", total_memory=n << 33))
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 570.12\n")
    program.chmod(0o755)
    monkeypatch.setattr("forbes.commands.doctor.shutil.which", lambda _: str(program))

    assert main(["doctor"]) == 0

    output = capsys.readouterr().out
    assert "H, 0 GiB" in output
    assert "H, 8 GiB" in output
    assert "570.12; torch is built for CUDA" in output
    assert "install torch for CUDA" not in output

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("forbes.commands.doctor._DRIVER_LIMIT", 0.5)
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert "install torch for CUDA" in output
    assert "nvidia-smi hangs, no answer within 0.5 s" in output


@pytest.mark.parametrize("argument", ["surplus", "--unknown"])
def test_the_doctor_takes_no_arguments(argument, capsys):
    assert main(["doctor", argument]) == 2

    assert f"unrecognized arguments: {argument}" in capsys.readouterr().err


def test_backends_are_tried_and_a_broken_one_has_its_remedy(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("MUJOCO_GL", "wgl")

    assert main(["doctor"]) == 0

    lines = capsys.readouterr().out.splitlines()
    found = {name: next(line for line in lines if f"rendering, {name}" in line) for name in ("egl", "osmesa", "wgl")}
    assert "llvmpipe (LLVM 15), 38 frames of 64 x 64 per second" in found["egl"]
    assert "no libOSMesa" in found["osmesa"]
    assert "apt-get install libosmesa6" in found["osmesa"]
    assert "unset MUJOCO_GL" in found["wgl"]
