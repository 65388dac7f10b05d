"""Roll-outs of one belief through time, and the digits that they show."""

import numpy as np
import pytest
import torch
from command_line import error_of

from forbes.data import SequenceDataModule, Strokes
from forbes.data.strokes.classifiers import load_classifiers
from forbes.evaluation.digits import completions
from forbes.evaluation.digits.completions import select_prefixes
from forbes.evaluation.predictions import Completions
from forbes.evaluation.runs import TrainedRun
from forbes.figures.simcore import count_changes, draw_simcore, read_digits


@pytest.fixture(scope="module")
def runs(tiny_run, tiny_vector):
    """FORBES, and a model without a state, on the same digits."""
    return [str(tiny_vector), str(tiny_run)]


@pytest.fixture(scope="module")
def data():
    return SequenceDataModule(Strokes(), length=30)


@pytest.fixture(scope="module")
def classifiers():
    return load_classifiers("bundled")


def test_a_digit_is_read_when_it_is_drawn_and_not_before(data, classifiers):
    """The first test digits are a seven, a two and a one; with one point none of them is any."""
    for index, label in enumerate((7, 2, 1)):
        steps = int(data.source.steps("test")[index])
        pictures = data.source.pictures(data.sequences("test", torch.tensor([index]), steps).observation)

        (digits,) = read_digits(pictures[None, :, 1:].float(), pictures, 1, [2, steps], classifiers)

        assert digits == [None, label]


@pytest.fixture
def count(data, classifiers, monkeypatch):
    """Count the changes of roll-outs that are made of the true drawings."""

    def of(play):
        def complete(model, source, batch, context, samples, mean=False):
            truth = source.pictures(batch.observation).float()[:, context:]  # (B, T - c, 1, H, W)
            return Completions(play(truth.expand(samples, *truth.shape).clone()), context)

        monkeypatch.setattr(completions, "complete", complete)
        prefixes = select_prefixes(data, "test", 40, 15, classifiers.prefix)
        return count_changes(TrainedRun("truth", torch.nn.Linear(1, 1), data, "", {}), prefixes, classifiers)

    return of


def test_true_digits_seldom_change(count):
    """95 % of true digits are clear at the end (data/README.md), and 85 % are read rightly after 15 points."""
    shown, changed = count(lambda frames: frames)

    assert shown.mean > 50
    assert changed.mean < 10


def test_drawings_that_end_as_a_seven_have_changed(count, data):
    """They are exchanged after 70 % of their way; only a tenth of the digits are sevens anyway."""
    seven = data.source.pictures(data.sequences("test", torch.tensor([0]), 100).observation)[0, -1].float()

    def exchange(frames):
        frames[:, :, int(0.7 * frames.shape[2]) :] = seven
        return frames

    shown, changed = count(exchange)

    assert shown.mean > 50
    assert changed.mean > 70


def test_the_roll_outs_of_each_model_are_followed(runs, capsys):
    figure = draw_simcore(runs, samples=3, context=3)["simcore"]

    out = capsys.readouterr().out
    vector, forbes = figure.axes[1::2]
    assert len(figure.axes) == 4
    for axes, name in ((vector, "Vector"), (forbes, "FORBES")):
        assert axes.get_title().startswith(f"{name}: ")
        assert f"{name}: " in out
        assert len(axes.texts) == 3 * len(axes.get_xticklabels())
    assert vector.images[0].get_array().shape[0] == 3 * 30 + 2


def test_the_same_runs_give_the_same_figure(runs):
    one, two = (draw_simcore(runs, samples=2, context=3)["simcore"] for _ in range(2))

    for first, second in zip(one.axes, two.axes, strict=True):
        np.testing.assert_array_equal(first.images[0].get_array(), second.images[0].get_array())
        assert first.get_title() == second.get_title()


def test_what_cannot_be_drawn_is_one_sentence(runs, capsys, tmp_path):
    figures = ("-o", str(tmp_path / "figures"))
    flags = ("--context", "6", *figures)
    assert "--context 6: expected less than" in error_of(capsys, "figures", "simcore", "--runs", *runs, *flags)
