"""The paper's figures come from run folders alone, and say what the runs say."""

import json
import shutil
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from forbes.commands.cli import main
from forbes.data import SequenceDataModule, Strokes
from forbes.data.strokes.file import StrokeArrays, save_strokes
from forbes.evaluation.runs import load_runs
from forbes.figures.elbo import FamilyCurves, draw_elbo, elbo_against_updates
from forbes.figures.families import group
from forbes.figures.grids import Panel, draw_panels
from forbes.figures.predictions import ambiguous_digits
from forbes.figures.style import BLACK, BLUE, METHODS, ORANGE, draw_references, paper_style, save_figure
from forbes.runs.folder import read_metrics


@pytest.fixture(scope="module")
def runs(tiny_run, tiny_forbes1, tiny_rssm):
    """FORBES with two seeds and RSSM with one."""
    return [str(tiny_run), str(tiny_forbes1), str(tiny_rssm)]


def draw(runs, output, *arguments):
    return main(["figures", "predictions", "--runs", *runs, "-o", str(output), "--context", "3", *arguments])


@pytest.fixture(scope="module")
def drawn(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    assert draw(runs, folder) == 0
    assert main(["figures", "elbo", "--runs", *runs, "-o", str(folder)]) == 0
    return folder


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("L"))


def test_each_figure_is_there_as_png_and_pdf(drawn):
    names = {"predictions-t6", "predictions-t9", "elbo"}  # sequences of 6, the longest test digit has 9 points
    assert {path.name for path in drawn.iterdir()} == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    for name in names:
        assert len(np.unique(pixels(drawn / f"{name}.png"))) > 10
        assert (drawn / f"{name}.pdf").read_bytes().startswith(b"%PDF")


def test_the_same_runs_give_the_same_bytes(runs, drawn, tmp_path):
    draw(runs, tmp_path)
    main(["figures", "5", "--runs", *runs, "-o", str(tmp_path)])
    for path in drawn.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()


def test_runs_that_differ_in_the_seed_only_are_one_family(runs, tmp_path):
    families = group(load_runs(runs))
    assert [family.name for family in families] == ["FORBES", "RSSM"]
    assert [len(family.curves()) for family in families] == [2, 1]
    assert [family.style for family in families] == [METHODS["FORBES"], METHODS["RSSM"]]


def test_families_of_one_name_are_told_apart_by_their_folders(runs, tiny_config, tmp_path):
    one, other = str(shutil.copytree(runs[0], tmp_path / "flat")), str(tmp_path / "deep")
    main(["fit", "--config", str(tiny_config), "--run_dir", other, "--model.init_args.belief.init_args.layers", "3"])
    names = [family.name for family in group(load_runs([one, other]))]
    assert names == ["FORBES (flat)", "FORBES (deep)"]


def test_a_family_curve_is_the_mean_and_ends_in_the_test_elbo(runs, tmp_path):
    copies = [str(shutil.copytree(run, tmp_path / str(number))) for number, run in enumerate(runs)]
    first, second, rssm = load_runs(copies)
    for run, mean, checkpoint in [
        (first, -90.0, first.checkpoint),
        (second, -100.0, second.checkpoint),
        (rssm, -80.0, "of an earlier epoch"),
    ]:
        metric = {"test/elbo[bernoulli,S=16]": {"mean": mean, "standard_error": 1.0, "checkpoint": checkpoint}}
        (tmp_path / run.path / "evaluation.json").write_text(json.dumps(metric))

    (axes,) = draw_elbo(copies)["elbo"].axes

    forbes, marker, rssm, *_ = axes.lines
    curves = [read_metrics(run)["val/elbo[bernoulli,S=1]"].dropna() for run in runs]
    assert list(forbes.get_xdata()) == [5, 10]
    assert forbes.get_ydata() == pytest.approx((curves[0] + curves[1]) / 2)
    assert rssm.get_ydata() == pytest.approx(curves[2])
    assert (*marker.get_xdata(), *marker.get_ydata()) == (10, -95.0)
    assert axes.get_ylim()[0] < -95.0 < axes.get_ylim()[1]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "FORBES, 2 runs",
        "RSSM",
        "final test",
    ]


def test_a_family_is_drawn_where_all_its_runs_have_values():
    curves = [pd.Series([-3.0, -2.0, -1.0], [10, 20, 30]), pd.Series([-5.0, -4.0], [10, 20])]
    (axes,) = elbo_against_updates([FamilyCurves("A", METHODS["FORBES"], "elbo[S=1]", curves, [])], {}).axes
    assert axes.get_ylabel() == "ELBO[S=1]\nvalidation, nats per sequence"
    assert list(axes.lines[0].get_xdata()) == [10, 20]
    assert list(axes.lines[0].get_ydata()) == [-4.0, -3.0]


def test_a_reference_far_above_the_curves_is_written():
    curves = [pd.Series([-5.0, -4.0, -3.0], [10, 20, 30])]
    family = FamilyCurves("A", METHODS["FORBES"], "elbo[S=1]", curves, [])
    figure = elbo_against_updates([family], {"mean frame": -900.0, "1-gram": -3.5, "last frame": 900.0})

    assert [text.get_text() for text in figure.axes[0].texts] == ["1-gram", "↑ last frame 900.0"]
    assert max(figure.axes[0].get_ylim()) < 0

    axes = Figure().subplots()
    axes.set_xlim(-5.0, -3.0)
    assert draw_references(axes, {"mean frame": -900.0, "last frame": -0.5}, along="x")
    assert not draw_references(axes, {"mean frame": -900.0}, along="x")
    assert [text.get_text() for text in axes.texts] == ["last frame −0.5 →"]
    assert axes.get_xlim() == (-5.0, -3.0)


def test_families_of_other_bounds_are_drawn_by_their_own(runs, tiny_particle, tiny_vector, tmp_path):
    particle, vector = (str(shutil.copytree(run, tmp_path / run.name)) for run in (tiny_particle, tiny_vector))
    for run, metric in [(particle, "test/elbo[bernoulli,S=16]"), (vector, "test/pll[bernoulli,K=128]")]:
        (tmp_path / run / "evaluation.json").write_text(json.dumps({metric: {"mean": -90.0}}))

    figure = draw_elbo([runs[0], particle, vector])["elbo"]

    (axes,), (legend,) = figure.axes, figure.legends
    assert axes.get_ylabel() == "bound\nvalidation, nats per sequence"
    assert [text.get_text() for text in legend.get_texts()] == [
        "FORBES, elbo[bernoulli,S=1]",
        "Particle, fivo[bernoulli,K=2]",
        "Vector, log_p[bernoulli]",
    ]  # and no diamond: an ELBO on the test split is not what these curves end in
    expected = read_metrics(vector)["val/log_p[bernoulli]"].dropna()
    assert axes.lines[2].get_ydata() == pytest.approx(expected)
    assert draw([runs[0], particle, vector], tmp_path / "figures", "--index", "3") == 0


def make_strokes(path, prefixes):
    """Digits of four points; the first three are (x, x + 1, x + 2) in row 5, and the class is as given."""
    splits = {}
    for split, digits in prefixes.items():
        points = np.array([[x + k, 5] for x, _ in digits for k in range(4)], np.uint8)
        pen_up = np.tile([False, False, False, True], len(digits))
        offsets = np.arange(0, 4 * len(digits) + 1, 4, dtype=np.int32)
        splits[split] = StrokeArrays(points, pen_up, offsets, np.array([label for _, label in digits], np.uint8))
    save_strokes(path, splits)
    return SequenceDataModule(Strokes(path=str(path), validation=0), batch_size=2, length=4)


def test_each_class_gives_the_digit_with_the_most_open_start(tmp_path):
    """At x = 0 all training digits are 1, at x = 20 all are 2, at x = 10 they are 1 or 2."""
    train = [(0, 1)] * 4 + [(20, 2)] * 4 + [(10, 1), (10, 2)] * 2
    test = [(0, 1), (20, 2), (10, 2), (10, 1), (10, 1)]
    data = make_strokes(tmp_path / "strokes.npz", {"train": train, "test": test})

    chosen = ambiguous_digits(data, context=3, neighbours=4)

    assert chosen.tolist() == [3, 2]  # of class 1 the first of two that are equally open, and of class 2


def test_a_digit_that_has_ended_is_not_completed(tmp_path):
    """The first test digit, as open as the second, ends within three steps."""
    path = tmp_path / "strokes.npz"
    make_strokes(path, {"train": [(10, 1), (10, 2)] * 2, "test": [(10, 1), (10, 1)]})
    with np.load(path) as arrays:
        values = dict(arrays)
    kept = np.array([0, 1, 3, 4, 5, 6, 7])  # without the third point of the first digit
    for name in ("test_points", "test_pen_up"):
        values[name] = values[name][kept]
    values["test_offsets"] = np.array([0, 3, 7], np.int32)
    np.savez(path, **values)
    data = SequenceDataModule(Strokes(path=str(path), validation=0), batch_size=2, length=4)

    assert ambiguous_digits(data, context=3, neighbours=2).tolist() == [1]


def test_a_run_without_a_test_split_is_named(capsys, tmp_path):
    agent = str(Path(__file__).parents[1] / "old_runs" / "agent")
    for figure in ("elbo", "per-step"):
        assert main(["figures", figure, "--runs", agent, "-o", str(tmp_path)]) == 2
        assert f"{agent}: its data have no test split" in capsys.readouterr().err


def test_other_digits_can_be_named(runs, tmp_path):
    draw(runs, tmp_path / "two", "--index", "3", "7")
    draw(runs, tmp_path / "one", "--index", "3")
    one, two = (len(pixels(tmp_path / name / "predictions-t6.png")) for name in ("one", "two"))
    assert two > 1.3 * one


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--index", "12"], "--index 12: the test split has 12 sequences"),
        (["--context", "6"], "--context 6: expected less than the length"),
        (["--samples", "none"], "--samples"),
    ],
)
def test_wrong_arguments_are_named(arguments, sentence, runs, tmp_path, capsys):
    assert draw(runs, tmp_path, *arguments) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_runs_of_different_data_are_refused(runs, tiny_config, tmp_path, capsys):
    other = str(tmp_path / "other")
    points = ["--data.init_args.source.init_args.points_per_step", "2"]
    main(["fit", "--config", str(tiny_config), "--run_dir", other, *points])
    assert draw([runs[0], other], tmp_path / "figures") == 2
    assert "Compare runs of the same data" in capsys.readouterr().err


def test_its_help_says_how_digits_are_chosen(capsys):
    with pytest.raises(SystemExit):
        main(["figures", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "forbes figures predictions --runs" in out
    assert "The choice does not depend on any model" in out


def test_a_panel_shows_each_frame_at_its_place_and_in_its_ink():
    images = torch.zeros(2, 3, 1, 4, 4)
    images[1, 2, 0, 0, 3] = 1.0
    figure = draw_panels([Panel("a", images, ORANGE), Panel("b", 1 - images, BLACK)])

    ink, other = (axes.images[0].get_array() for axes in figure.axes)

    # Frames of 4 pixels with gaps of 2: row 1 starts at 8, column 2 at 14.
    np.testing.assert_allclose(ink[8, 17], mpl.colors.to_rgb(ORANGE), rtol=1e-6)
    np.testing.assert_allclose(ink[8, 16], 1.0)
    np.testing.assert_allclose(other[8, 16], mpl.colors.to_rgb(BLACK), rtol=1e-6)
    widths = {tuple(np.round(axes.get_position().size, 6)) for axes in figure.axes}
    assert len(widths) == 1


def test_a_picture_replaces_the_old_one_without_leftovers(tmp_path):
    figure = draw_panels([Panel("a", torch.ones(1, 1, 1, 4, 4), BLUE)])
    for _ in range(2):
        save_figure(figure, tmp_path / "new" / "a.png")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]


def test_the_style_is_for_our_pictures_only():
    before = mpl.rcParams["axes.grid"]
    with paper_style():
        assert mpl.rcParams["axes.grid"] is not before
    assert mpl.rcParams["axes.grid"] is before
