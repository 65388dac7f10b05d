"""`forbes completions`, as a user calls it, and its pictures."""

import hashlib
import itertools
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
import torch
from command_line import error_of

from forbes.commands.cli import main
from forbes.commands.completions import _shared_data
from forbes.data import SequenceDataModule, Strokes
from forbes.data.strokes import classifiers
from forbes.figures.completions import by_ambiguity
from forbes.figures.grids import Bars, Panel, draw_bands, draw_panels
from forbes.figures.style import BLUE
from forbes.runs.folder import RunFolder, read_config

NUMBERS = ["--digits", "12", "--samples", "4", "--prefixes", "3", "2"]


@pytest.fixture(scope="module")
def runs(tiny_run, tiny_rssm):
    """A run of FORBES and one of RSSM."""
    return [str(tiny_run), str(tiny_rssm)]


@pytest.fixture(scope="module")
def completed(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("completions")
    assert main(["completions", *runs, *NUMBERS, "-o", str(folder)]) == 0
    return folder


def test_pictures_and_tables_are_there(completed):
    names = {"completions-c2", "completions-c3", "completions-scores", "completions-errors"}
    expected = {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    assert {path.name for path in completed.iterdir()} == expected | {"completions.json", "completions.csv"}


def test_runs_of_other_lengths_and_with_observed_ends_complete_the_same_digits(runs, tiny_config, tmp_path):
    longer = str(tmp_path / "longer")
    length = read_config(RunFolder(runs[0]).config)["data"]["init_args"]["length"]
    longer_digits = ["--data.length", str(length + 3), "--data.source.end", "observed"]
    assert main(["fit", "--config", str(tiny_config), "--run_dir", longer, *longer_digits]) == 0

    assert main(["completions", longer, runs[0], *NUMBERS, "-o", str(tmp_path / "figures")]) == 0
    scores = pd.read_csv(tmp_path / "figures" / "completions.csv")
    assert {name.partition("<=")[2] for name in scores["metric"] if "<=" in name} == {f"{length}]"}
    assert scores[scores["minus"].notna()]["run"].unique().tolist() == [longer]


def test_the_order_of_runs_does_not_change_the_reference(strokes_file):
    """The 5-gram is fitted on the shortest sequences, with masked ends if a run has them."""
    sources = [Strokes(path=str(strokes_file), end=end) for end in ("observed", "masked", "observed")]
    runs = [
        SimpleNamespace(data=SequenceDataModule(source, length=length))
        for source, length in zip(sources, (6, 6, 9), strict=True)
    ]

    for ordered in itertools.permutations(runs):
        assert _shared_data(ordered) is runs[1].data


def test_the_record_says_what_was_measured_and_how(completed, runs):
    record = json.loads((completed / "completions.json").read_text())

    assert record["command"].startswith(f"forbes completions {runs[0]} {runs[1]} --digits 12")
    assert record["seed"] == 0
    assert record["classifiers"] == classifiers.CLASSIFIERS_SHA256
    assert [run["checkpoint"] for run in record["runs"]] == [
        hashlib.sha256(RunFolder(run).checkpoint.read_bytes()).hexdigest() for run in runs
    ]
    assert {"commit", "data"} <= record.keys()
    assert len(pd.read_csv(completed / "completions.csv")) == len(record["scores"])
    curve = next(one for one in record["curves"] if one["row"] == "RSSM" and one["c"] == 3)
    assert len(curve["best"]) == len(curve["average"]) == 4


def test_the_record_names_the_checkpoints_that_were_measured(runs, tmp_path, overwritten):
    copies = [str(shutil.copytree(run, tmp_path / str(number))) for number, run in enumerate(runs)]
    assert main(["completions", *copies, *NUMBERS, "-o", str(tmp_path)]) == 0

    found = json.loads((tmp_path / "completions.json").read_text())["runs"]
    assert [run["checkpoint"] for run in found] == [overwritten[str(RunFolder(run).checkpoint)] for run in copies]


def test_paired_differences_average_to_the_score_difference(completed, runs):
    table = pd.read_csv(completed / "completions.csv")
    name = "test[:12]/energy[c=2,N=4,end]"
    of_metric = table[table["metric"] == name].set_index(["row", "minus"])["mean"]

    assert of_metric["FORBES", runs[1]] == pytest.approx(of_metric["FORBES", np.nan] - of_metric["RSSM", np.nan])
    truth = table[(table["row"] == "true digits") & (table["metric"] == name)]
    assert truth["mean"].tolist() == [0.0]


def test_the_same_command_gives_the_same_numbers(completed, runs, tmp_path, capsys):
    assert main(["completions", *runs, *NUMBERS, "-o", str(tmp_path)]) == 0

    out = capsys.readouterr().out
    for words in (
        "12 digits, 2 steps seen, 4 completions",
        "reference",
        "5-gram",
        "true digits",
        "similar digits",
        "FORBES − RSSM",
    ):
        assert words in out
    assert (tmp_path / "completions.csv").read_bytes() == (completed / "completions.csv").read_bytes()
    assert (tmp_path / "completions-c2.png").read_bytes() == (completed / "completions-c2.png").read_bytes()


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--prefixes", "2", "6"], "--prefixes 6: the sequences of"),
        (["--samples", "1"], "--samples 1: expected at least 2"),
        (["--digits", "13"], "--sequences 13: the test split of"),
        (["--digits", "1"], "of 1 digits 1 continue after 2 steps, expected at least 2"),
        (["--prefixes", "none"], "--prefixes"),
    ],
)
def test_wrong_numbers_are_named(flags, sentence, runs, tmp_path, capsys):
    assert sentence in error_of(
        capsys, "completions", *runs, *NUMBERS[:4], "--prefixes", "2", *flags, "-o", str(tmp_path)
    )
    assert list(tmp_path.iterdir()) == []


def test_runs_that_do_not_fit_are_named(runs, tiny_config, tmp_path, capsys):
    other = str(tmp_path / "other")
    points = ["--data.init_args.source.init_args.points_per_step", "2"]
    assert main(["fit", "--config", str(tiny_config), "--run_dir", other, *points]) == 0
    assert "Compare runs of the same data" in error_of(capsys, "completions", runs[0], other, *NUMBERS)

    config = Path(__file__).parents[2] / "configs" / "pomdp" / "linear_gaussian" / "rssm.yaml"
    vectors = str(tmp_path / "vectors")
    small = ["--data.updates_per_epoch=1", "--trainer.max_epochs=1", "--trainer.log_every_n_steps=1"]
    assert main(["fit", "--config", str(config), *small, "--run_dir", vectors]) == 0
    assert "expected Strokes. Name other runs" in error_of(capsys, "completions", vectors, *NUMBERS)


def test_missing_classifiers_are_an_error(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(classifiers, "classifiers_path", lambda: tmp_path / "classifiers.npz")
    assert "classifiers.npz: no such file" in error_of(capsys, "completions", *runs, *NUMBERS)


def test_digits_are_drawn_from_the_most_to_the_least_ambiguous():
    sharpness = torch.tensor([0.0, 9.0, 1.0, 3.0, 2.0], dtype=torch.float64)
    reference = (sharpness[:, None] * torch.eye(10, dtype=torch.float64)[0]).softmax(-1)  # (5, 10)

    assert by_ambiguity(reference, 5).tolist() == [0, 2, 4, 3, 1]
    assert by_ambiguity(reference, 3).tolist() == [0, 4, 1]
    assert by_ambiguity(reference, 9).tolist() == [0, 2, 4, 3, 1]


def test_titles_of_a_band_do_not_overlap_the_labels_above():
    frames = torch.ones(2, 1, 1, 4, 4)
    bands = [[Panel("a", frames, BLUE), Bars("b", np.ones((2, 3)), BLUE)], [Panel("c", frames, BLUE)]]

    figure = draw_bands(bands)

    first, bars, second = figure.axes
    apart = (first.get_position().y0 - second.get_position().y1) * figure.get_figheight()  # inches
    assert apart * 72 > first.title.get_fontsize() + bars.get_xticklabels()[0].get_fontsize() + 4  # points
    assert second.get_position().y0 > 0
    assert first.get_position().width == pytest.approx(second.get_position().width)


def test_bars_stand_beside_their_row_with_their_note():
    shares = np.array([[0.25, 0.75], [1.0, 0.0]])
    figure = draw_panels([Panel("a", torch.ones(2, 1, 1, 4, 4), BLUE), Bars("b", shares, BLUE, notes=["H", "I"])])

    frames, bars = figure.axes

    heights = [bar.get_height() for bar in bars.patches if isinstance(bar, mpl.patches.Rectangle)]
    assert np.array(heights).reshape(2, 2) / heights[2] == pytest.approx(shares)
    assert [bar.get_y() for bar in bars.patches] == [1, 1, 0, 0]
    assert bars.get_position().bounds[1::2] == pytest.approx(frames.get_position().bounds[1::2])
    assert [text.get_text() for text in bars.texts] == ["H", "I"]
    assert max(heights) < 1
