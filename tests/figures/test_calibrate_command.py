"""`forbes calibrate`, as a user calls it."""

from pathlib import Path

import pytest

from forbes.cli import main

CONFIG = Path(__file__).parents[2] / "configs" / "pomdp" / "linear_gaussian" / "rssm.yaml"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A world model of vectors that has made one update."""
    folder = tmp_path_factory.mktemp("calibrated") / "rssm"
    small = ["--data.updates_per_epoch=1", "--trainer.max_epochs=1", "--trainer.log_every_n_steps=1"]
    assert main(["fit", "--config", str(CONFIG), *small, "--run_dir", str(folder)]) == 0
    return str(folder)


def test_it_prints_the_coverage_and_draws_the_ranks(run, tmp_path, capsys):
    numbers = ["--sequences", "60", "--samples", "19", "--time", "3"]

    assert main(["calibrate", run, *numbers, "-o", str(tmp_path)]) == 0

    out = capsys.readouterr().out
    assert "60 states drawn from the model, ranked among 19 of the belief" in out
    assert "within 90 %" in out
    assert {path.name for path in tmp_path.iterdir()} == {"calibration.png", "calibration.pdf"}


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--time", "16"], "have 15 steps"),
        (["--sequences", "10001"], "was trained on 10000 sequences"),
        (["--samples", "5", "--sequences", "60"], "Choose fewer bins"),
    ],
)
def test_what_cannot_be_checked_is_said_in_one_sentence(run, tmp_path, capsys, flags, expected):
    assert main(["calibrate", run, "--time", "3", *flags, "-o", str(tmp_path)]) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line
    assert list(tmp_path.iterdir()) == []
