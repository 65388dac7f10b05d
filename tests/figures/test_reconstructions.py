"""Ten frames, their reconstructions and predictions."""

import numpy as np
import pytest
import torch
from small_agents import forbes

from forbes.commands.cli import main
from forbes.evaluation.runs import load_runs
from forbes.figures import reconstructions
from forbes.figures.reconstructions import draw_reconstructions


@pytest.fixture(scope="module")
def runs(tiny_run, tiny_rssm, tiny_vector):
    """FORBES, an RSSM and a model without a state on the same digits of 6 steps."""
    return [str(tiny_run), str(tiny_rssm), str(tiny_vector)]


def rows(figure):
    return [axes.get_yticklabels()[0].get_text() for axes in figure.axes]


def test_the_truth_is_above_each_models_reconstruction_and_prediction(runs):
    drawn = draw_reconstructions(runs, context=2)

    figure = drawn["reconstructions"]
    assert list(drawn) == ["reconstructions"]
    models = ["FORBES", "FORBES,\npredicted", "RSSM", "RSSM,\npredicted", "Vector,\npredicted"]
    assert rows(figure) == ["truth", *models]
    assert [text.get_text() for text in figure.axes[-1].get_xticklabels()] == [f"t={time}" for time in range(1, 7)]
    assert figure.axes[0].get_title() == "predictions after t = 2"
    for axes in figure.axes:
        assert axes.images[0].get_array().shape == (28 + 4, 6 * 30 + 2, 3)


def test_several_sequences_follow_each_other(runs):
    figure = draw_reconstructions(runs[:1], index=[3, 1], context=2)["reconstructions"]

    assert rows(figure) == ["truth", "FORBES", "FORBES,\npredicted"] * 2
    first, second = (figure.axes[row].images[0].get_array() for row in (0, 3))
    assert not np.array_equal(first, second)


def test_predictions_begin_after_the_context(runs):
    (run,) = load_runs(runs[:1])
    batch = run.data.sequences("test", torch.arange(3))

    predicted = reconstructions._predicted(run, batch, 4)
    reconstructed = reconstructions._reconstructed(run, batch)

    assert predicted.shape == reconstructed.shape == batch.observation.shape
    assert not predicted[:, :4].any()
    assert predicted[:, 4:].all()  # probabilities of ink, which are never 0
    assert reconstructed.all()


def test_an_agent_is_drawn_on_its_newest_episode(small_image_agent, tmp_path, capsys):
    assert forbes("figures", "reconstructions", "--runs", small_image_agent, "--context", 2, "-o", tmp_path) == 0

    assert {path.name for path in tmp_path.iterdir()} == {"reconstructions.png", "reconstructions.pdf"}


def test_models_of_other_data_have_a_figure_of_their_own(small_image_agent, runs):
    names = list(draw_reconstructions([str(small_image_agent), runs[0]], context=2))

    assert names == ["reconstructions-Slide", "reconstructions-strokes"]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--context", "6"], "--context 6: expected at least 1 and less than the length of the sequences, 6"),
        (["--index", "0", "12"], "has 12 sequences to draw, expected 0 to 11"),
    ],
)
def test_what_does_not_fit_is_one_sentence(flags, sentence, runs, tmp_path, capsys):
    assert main(["figures", "reconstructions", "--runs", runs[0], *flags, "-o", str(tmp_path)]) == 2
    assert sentence in capsys.readouterr().err


def test_vectors_are_no_frames(small_agent, tmp_path, capsys):
    assert forbes("figures", "reconstructions", "--runs", small_agent, "-o", tmp_path) == 2
    assert "the observations are vectors of 2, expected images" in capsys.readouterr().err
