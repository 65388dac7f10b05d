"""The doctor finds what is missing, and says what to do."""

import pytest

from forbes.cli import main


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
