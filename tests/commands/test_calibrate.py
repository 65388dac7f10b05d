"""`forbes calibrate`, as a user calls it."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from forbes.commands.cli import main
from forbes.runs.folder import RunFolder

CONFIG = Path(__file__).parents[2] / "configs" / "pomdp" / "linear_gaussian" / "rssm.yaml"


def fit(folder, *flags):
    """A world model of vectors that has made one update."""
    small = ["--data.updates_per_epoch=1", "--trainer.max_epochs=1", "--trainer.log_every_n_steps=1"]
    assert main(["fit", "--config", str(CONFIG), *small, *flags, "--run_dir", str(folder)]) == 0
    return str(folder)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return fit(tmp_path_factory.mktemp("calibrated") / "rssm")


def test_it_prints_the_coverage_and_draws_the_ranks(run, tmp_path, capsys):
    numbers = ["--sequences", "60", "--samples", "19", "--time", "3"]

    assert main(["calibrate", run, *numbers, "-o", str(tmp_path)]) == 0

    out = capsys.readouterr().out
    assert "60 states sampled from the model" in out
    assert "within 90 %" in out
    assert "p, classifier" in out
    assert {path.name for path in tmp_path.iterdir()} == {f"calibration.{kind}" for kind in ("png", "pdf", "json")}
    record = json.loads((tmp_path / "calibration.json").read_text())
    assert (record["sequences"], record["samples"], record["time"], record["seed"]) == (60, 19, 3, 0)
    (tested,) = record["runs"]
    assert tested["run"] == run
    assert f"{tested['within_90']:.1%}" in out
    assert all(f"{tested[f'p_{name}']:.2g}" in out for name in ("density", "tarp", "values", "classifier"))


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--time", "16"], "have 15 steps"),
        (["--sequences", "10001"], "was trained on 10000 sequences"),
        (["--samples", "8"], "--samples 8: expected at least 9, for a test of ranks in 10 bins"),
        (["--sequences", "49"], "--sequences 49: expected at least 50, for a test of ranks in 10 bins"),
    ],
)
def test_what_cannot_be_checked_is_said_in_one_sentence(run, tmp_path, capsys, flags, expected):
    assert main(["calibrate", run, "--time", "3", *flags, "-o", str(tmp_path)]) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("belief", "family"), [("MixtureBelief", "Mixture"), ("CategoricalBelief", "Categorical")])
def test_every_family_is_ranked(tmp_path, capsys, belief, family):
    run = fit(tmp_path / "run", "--model.belief", belief, *["--model.belief.classes", "2"] * (family == "Categorical"))

    assert main(["calibrate", run, "--sequences", "60", "--samples", "19", "--time", "3", "-o", str(tmp_path)]) == 0
    assert family in capsys.readouterr().out


def test_a_model_that_has_diverged_is_named(run, tmp_path, capsys):
    folder = RunFolder(shutil.copytree(run, tmp_path / "run"))
    checkpoint = torch.load(folder.checkpoint, weights_only=True)
    next(value for name, value in checkpoint["state_dict"].items() if "gru" in name).fill_(float("nan"))
    torch.save(checkpoint, folder.checkpoint)

    assert main(["calibrate", str(folder), "--sequences", "60", "--time", "3", "-o", str(tmp_path / "figures")]) == 2
    assert f"forbes: {folder}: " in capsys.readouterr().err.splitlines()[-1]


def test_particles_are_ranked_and_a_stateless_model_is_refused(tmp_path, capsys):
    numbers = ["--sequences", "60", "--samples", "19", "--time", "3", "-o", str(tmp_path / "figures")]
    particle = fit(tmp_path / "particle", "--model.model", "ParticleModel", "--model.model.particles", "4")
    vector = fit(tmp_path / "vector", "--model.model", "VectorModel", "--model.state_dim", "0")

    assert main(["calibrate", particle, *numbers]) == 0
    assert "Particle" in capsys.readouterr().out
    assert main(["calibrate", particle, *numbers, "--particles", "8"]) == 0
    assert main(["calibrate", vector, *numbers]) == 2
    assert "a Vector model has no state that could be ranked" in capsys.readouterr().err
