"""The ELBO of stored episodes, from what run folders have recorded."""

import numpy as np
import pytest
from recorded_runs import write_run

from forbes.commands.cli import main
from forbes.figures.dmc_elbo import draw_dmc_elbo
from forbes.figures.style import METHODS

BOUND = "elbo[normal(1),S=1]"


@pytest.fixture
def recorded(tmp_path):
    def write(name, belief="FlowBelief", values=(1, 2, 3), store="cartpole", bound=f"val/{BOUND}", **more):
        lines = [{"update": 10 * k, bound: float(value)} for k, value in enumerate(values)]
        options = {"path": f"/episodes/{store}"}
        return write_run(tmp_path / name, "WorldModel", belief, "Replay", options, lines, **more)

    return write


def test_every_store_has_a_panel_with_mean_and_range_over_seeds(recorded):
    runs = [
        recorded("a", values=(1, 2, 5)),
        recorded("b", values=(3, 4, 9), seed=1),
        recorded("c", "GaussianBelief", (0, 0, 1)),
        recorded("d", store="finger"),
    ]

    figure = draw_dmc_elbo(runs)["dmc-elbo"]

    cartpole, finger = figure.axes
    assert [axes.get_title() for axes in figure.axes] == ["cartpole", "finger"]
    assert cartpole.get_ylabel() == "validation ELBO\nnats per sequence"
    assert [text.get_text() for text in cartpole.get_legend().get_texts()] == ["FORBES, 2 seeds", "RSSM"]
    np.testing.assert_allclose(cartpole.lines[0].get_xydata(), [[0, 2], [10, 3], [20, 7]])
    assert [line.get_color() for line in cartpole.lines] == [METHODS[name].colour for name in ("FORBES", "RSSM")]
    assert len(finger.lines) == 1


def test_agents_are_drawn_with_the_bound_of_their_training(recorded, tmp_path):
    lines = [{"update": 0, f"train/{BOUND}": -9.0}, {"update": 10, f"train/{BOUND}": -5.0}]
    run = write_run(
        tmp_path / "agent", "ImaginationActorCritic", "GaussianBelief", "Experience", {"task": "hop"}, lines
    )

    (axes,) = draw_dmc_elbo([run])["dmc-elbo"].axes

    assert axes.get_ylabel() == "training ELBO\nnats per sequence"
    assert axes.get_legend().get_texts()[0].get_text() == "Dreamer"


def test_what_cannot_be_drawn_is_one_sentence(recorded, tmp_path, capsys):
    strokes = write_run(tmp_path / "strokes", "WorldModel", "FlowBelief", "Strokes", {}, [])
    for runs, sentence in [
        ([strokes], "strokes: its data are Strokes, expected Replay or Experience. Draw it by: forbes figures elbo"),
        ([recorded("new", bound="train/kl")], "new: metrics.jsonl has no bound. Train the run further"),
        (
            [recorded("five"), recorded("eight", bound="val/elbo[normal(2),S=1]", horizon=8)],
            f"eight: its bound is val/elbo[normal(2),S=1], that of {tmp_path / 'five'} is val/{BOUND}, expected",
        ),
    ]:
        assert main(["figures", "dmc-elbo", "--runs", *runs, "-o", str(tmp_path / "figures")]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1
