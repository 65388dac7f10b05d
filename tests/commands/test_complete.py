"""`forbes complete` draws a model's completions, the same for the same seed, or says why it cannot."""

import pytest
import torch
from command_line import error_of
from matplotlib.figure import Figure

from forbes.commands.cli import main
from forbes.figures.prediction_grid import prediction_grid
from forbes.training.loading import load_run

SMALL = ["--context", "3", "--samples", "2"]


def test_the_picture_depends_on_the_seed_only(tiny_run, tmp_path):
    pictures = []
    for name, seed in (("a.png", "0"), ("b.png", "0"), ("c.png", "1")):
        assert main(["complete", str(tiny_run), "-o", str(tmp_path / name), *SMALL, "--seed", seed]) == 0
        pictures.append((tmp_path / name).read_bytes())

    assert pictures[0].startswith(b"\x89PNG")
    assert pictures[0] == pictures[1] != pictures[2]


def test_a_pdf_of_chosen_sequences_is_written(tiny_run, tmp_path):
    chosen = ["--split", "validation", "--index", "3", "0"]

    assert main(["complete", str(tiny_run), "-o", str(tmp_path / "new" / "a.pdf"), *SMALL, *chosen]) == 0

    assert (tmp_path / "new" / "a.pdf").read_bytes().startswith(b"%PDF")


def test_completions_are_drawn_at_the_training_length_and_the_end(tiny_run):
    world, data = load_run(tiny_run)
    batch = data.sequences("test", torch.arange(4), 9)

    figure = prediction_grid(world.model, data, batch, context=3, samples=2)

    assert isinstance(figure, Figure)
    titles = [axes.get_title().replace("\n", " ") for axes in figure.axes]
    assert titles == ["truth", "seen", "sampled completions, t = 6", "sampled completions, t = 9"]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (["--context", "6"], "--context 6: expected less than the length of the sequences, 6"),
        (["--index", "12"], "--index 12: the test split has 12 sequences, expected 0 to 11"),
        (["--index", "-1"], "--index -1: the test split has 12 sequences"),
        (["-o", "picture.xyz"], "picture.xyz: is not the name of an image"),
        (["--samples", "0"], "0 is not a number above 0"),
    ],
)
def test_a_wrong_argument_is_one_sentence(tiny_run, in_tmp_path, capsys, wrong, sentence):
    assert sentence in error_of(capsys, "complete", tiny_run, "-o", "a.png", *SMALL, *wrong)
    assert list(in_tmp_path.iterdir()) == []
