"""Backends are proved in a process of their own: one that hangs, crashes or lies is named with its remedy."""

import pytest

from forbes.commands.cli import main
from forbes.envs import rendering
from forbes.envs.rendering import Probe, choose_backend, probe_backend
from forbes.errors import ForbesError


@pytest.fixture
def unasked(monkeypatch):
    """No MUJOCO_GL, and nothing remembered of this machine, before and after."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    choose_backend.cache_clear()
    yield
    choose_backend.cache_clear()


def test_a_backend_that_hangs_is_given_up():
    probe = probe_backend("egl", timeout=0.01)

    assert probe.problem == "no frame within 0.01 s"
    assert "apt-get install libegl1" in probe.remedy


def test_a_backend_that_does_not_exist_says_why():
    probe = probe_backend("nonsense")

    assert "MUJOCO_GL" in probe.problem
    assert probe.remedy == "unset MUJOCO_GL"


def test_the_first_backend_that_renders_is_taken(unasked, monkeypatch):
    answers = {"egl": Probe("egl", problem="no driver"), "osmesa": Probe("osmesa", "llvmpipe", 30.0)}
    monkeypatch.setattr(rendering, "probe_backend", answers.get)

    assert choose_backend() == answers["osmesa"]


def test_only_the_backend_that_the_user_chose_is_probed(unasked, monkeypatch):
    asked = []
    monkeypatch.setattr(rendering, "probe_backend", lambda name: asked.append(name) or Probe(name, problem="broken"))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")

    with pytest.raises(ForbesError, match=r"MUJOCO_GL=osmesa does not render \(osmesa: broken\)"):
        choose_backend()
    assert asked == ["osmesa"]


def test_without_a_backend_there_is_one_sentence(unasked, monkeypatch):
    monkeypatch.setattr(rendering, "probe_backend", lambda name: Probe(name, problem=f"{name} is broken"))

    with pytest.raises(ForbesError) as error:
        choose_backend()
    assert str(error.value) == (
        "rendering: no backend renders (egl: egl is broken; osmesa: osmesa is broken). Run `forbes doctor` "
        "for a remedy, or observe vectors with --no-pixels"
    )


def test_a_gpu_that_does_not_draw_is_noticed(monkeypatch):
    monkeypatch.setattr(rendering.shutil, "which", lambda _: "/usr/bin/nvidia-smi")

    assert "NVIDIA_DRIVER_CAPABILITIES" in Probe("egl", "llvmpipe (LLVM 15)", 30.0).remedy
    assert Probe("egl", "NVIDIA H100", 900.0).remedy == ""


def test_collecting_pixels_without_rendering_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")

    status = main(["data", "collect", "--task", "cartpole_balance", "--episodes", "1", "-o", str(tmp_path / "store")])

    output = capsys.readouterr().err
    assert status == 2
    assert output.startswith("forbes: rendering: MUJOCO_GL=nonsense does not render")
    assert output.count("\n") == 1
