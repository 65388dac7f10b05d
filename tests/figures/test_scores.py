"""The figures of recorded scores show what `evaluation.json` says, of the runs' own checkpoints."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import error_of
from matplotlib.backends.backend_agg import FigureCanvasAgg

from forbes.evaluation.runs import load_runs
from forbes.figures.catalogue import draw
from forbes.figures.scores import draw_per_step, draw_prequential
from forbes.figures.style import METHODS


@pytest.fixture(scope="module")
def trained(tiny_run, tiny_rssm):
    """An RSSM next to FORBES."""
    return str(tiny_run), str(tiny_rssm)


@pytest.fixture
def record(trained, tmp_path):
    """Copies of FORBES and RSSM with records of their scores, given as a curve by metric."""

    def make(kind, name, sha256="same", checkpoint=None, **curves):
        run = str(shutil.copytree(trained[kind], tmp_path / name))
        (one,) = load_runs([run])
        entries = {
            metric: {
                "mean": sum(curve),
                "standard_error": 1.0,
                "curve": curve,
                "sequences": 12,
                "data": {"name": "strokes", "sha256": sha256},
                "checkpoint": checkpoint or one.checkpoint,
            }
            for metric, curve in {f"test/{score}[S=2]": curve for score, curve in curves.items()}.items()
        }
        (tmp_path / name / "evaluation.json").write_text(json.dumps(entries))
        return run

    return make


def test_the_elbo_of_each_step_is_the_mean_over_the_runs_of_a_family(record):
    first = record(0, "forbes-0", elbo=[-3.0, -1.0], reconstruction=[-1.0, 0.0], kl=[2.0, 1.0])
    second = record(0, "forbes-1", elbo=[-5.0, -2.0], reconstruction=[-1.0, 0.0], kl=[4.0, 2.0])

    bound, reconstruction, kl = draw_per_step([first, second])["per-step"].axes

    np.testing.assert_allclose(bound.lines[0].get_xdata(), [1, 2])
    np.testing.assert_allclose(bound.lines[0].get_ydata(), [-4.0, -1.5])
    np.testing.assert_allclose(reconstruction.lines[0].get_ydata(), [-1.0, 0.0])
    np.testing.assert_allclose(kl.lines[0].get_ydata(), [3.0, 1.5])
    assert bound.lines[0].get_color() == METHODS["FORBES"].colour
    shade = bound.collections[0].get_paths()[0].vertices
    assert (shade[:, 1].min(), shade[:, 1].max()) == (-5.0, -1.0)


def test_the_prequential_score_is_relative_to_the_first_family(record):
    forbes = record(0, "forbes-0", pll=[-3.0, -1.0])
    rssm = record(1, "rssm-0", pll=[-3.5, -2.0])

    steps, totals = draw_prequential([forbes, rssm])["prequential"].axes

    np.testing.assert_allclose(steps.lines[0].get_ydata(), [0.0, 0.0])
    np.testing.assert_allclose(steps.lines[1].get_ydata(), [-0.5, -1.0])
    assert [line.get_xdata()[0] for line in totals.lines[:2]] == [-4.0, -5.5]
    assert [label.get_text() for label in totals.get_yticklabels()] == ["FORBES", "RSSM"]


@pytest.mark.parametrize("beside", [-5.5, -5.6])
def test_the_label_of_a_reference_covers_no_marker(beside, record):
    runs = [record(0, "forbes-0", pll=[-3.0, -1.0]), record(1, "rssm-0", pll=[-3.5, -2.0])]
    path = Path(runs[0]) / "evaluation.json"
    entries = json.loads(path.read_text())
    entries["test/pll[S=2]"]["references"] = {
        name: {"mean": mean, "standard_error": 0.1} for name, mean in {"1-gram": -6.0, "5-gram": beside}.items()
    }
    path.write_text(json.dumps(entries))

    figure = draw_prequential(runs)["prequential"]

    FigureCanvasAgg(figure).draw()
    totals = figure.axes[1]
    (label,) = totals.texts
    assert label.get_text() == "5-gram"
    markers = [line for line in totals.lines if line.get_marker() not in (None, "None", "", "|")]
    assert len(markers) == 2
    for line in markers:
        (x, y) = totals.transData.transform(line.get_xydata()[0])
        assert not label.get_window_extent().padded(line.get_markersize() / 2).contains(x, y)


def test_scores_of_other_data_or_checkpoints_are_refused(record, capsys, tmp_path):
    first = record(0, "forbes-0", pll=[-3.0, -1.0])
    draw = ["figures", "prequential", "-o", tmp_path / "figures", "--runs", first]

    for other in (
        record(1, "rssm-0", elbo=[-3.0, -1.0]),
        record(1, "rssm-1", pll=[-3.0, -1.0], sha256="other"),
        record(1, "rssm-2", pll=[-3.0, -1.0], checkpoint="of an earlier epoch"),
    ):
        sentence = error_of(capsys, *draw, other)
        assert "evaluation.json has no pll of this checkpoint" in sentence
        assert f"Run: forbes evaluate {first} {other}" in sentence
    assert not (tmp_path / "figures").exists()


@pytest.mark.parametrize("figure", ["elbo", "per-step", "prequential"])
def test_what_is_recorded_is_drawn_without_checkpoints(figure, record, tmp_path):
    scores = {"elbo": [-50.0, -40.0], "reconstruction": [-1.0, 0.0], "kl": [2.0, 1.0], "pll": [-2.5, -1.0]}
    runs = [record(0, "forbes-0", **scores), record(1, "rssm-0", **scores)]
    drawn = [path.read_bytes() for path in draw(figure, runs, tmp_path / "with")]

    for run in runs:
        shutil.rmtree(Path(run) / "checkpoints")

    assert [path.read_bytes() for path in draw(figure, runs, tmp_path / "without")] == drawn


def test_a_named_checkpoint_must_exist_for_a_figure_of_records(record, capsys, tmp_path):
    run = record(0, "forbes-0", pll=[-3.0, -1.0])
    missing = f"{run}/checkpoints/worst.ckpt"
    sentence = error_of(capsys, "figures", "prequential", "-o", tmp_path / "figures", "--runs", missing)
    assert sentence.startswith(f"{missing}: no such checkpoint. There are ")
