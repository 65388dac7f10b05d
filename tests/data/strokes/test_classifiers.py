"""The digit classifiers that come with the package are what `data/README.md` says, and nothing else is read."""

import math
import re

import numpy as np
import pytest
import torch

from forbes.commands import data as commands
from forbes.commands.parsers.data import main
from forbes.data import Strokes
from forbes.data.strokes import classifier_training
from forbes.data.strokes import classifiers as shipped
from forbes.data.strokes.classifier_training import (
    calibrate,
    classify,
    digits_of,
    draw_finished,
    fit_classifier,
    quality,
)
from forbes.data.strokes.classifiers import CLASSIFIERS_SHA256, calibration_error, classifiers_path, load_classifiers
from forbes.errors import ForbesError

DIGITS = 1000


@pytest.fixture(scope="module")
def classifiers():
    return load_classifiers("bundled")


@pytest.fixture(scope="module")
def digits():
    """The first test digits."""
    return digits_of(Strokes(), "test").take(torch.arange(DIGITS))


def stated(network, points):
    """The accuracy that the README states for the bundled strokes."""
    text = classifiers_path().with_name("README.md").read_text("utf-8")
    (accuracy,) = re.findall(rf"\| {network} \| bundled \| {points} \| [\d,]+ \| ([\d.]+) % \|", text)
    return float(accuracy) / 100


@pytest.mark.parametrize(("network", "points"), [("finished", None), ("prefix", 5), ("prefix", 10), ("prefix", 15)])
def test_a_classifier_is_as_accurate_as_the_readme_says(network, points, classifiers, digits):
    expected = stated(network, points or "all")

    found = quality(*classify(getattr(classifiers, network), digits, points))

    four_errors = 4 * math.sqrt(expected * (1 - expected) / found.digits)
    assert found.accuracy == pytest.approx(expected, abs=four_errors)


def test_finished_digits_are_told_apart_in_98_of_100_cases():
    assert stated("finished", "all") >= 0.98


@pytest.mark.parametrize("points", [5, 10, 15])
def test_a_prefix_classifier_is_right_as_often_as_it_says(points, classifiers, digits):
    log_probs, labels = classify(classifiers.prefix, digits, points)

    confidence, choice = log_probs.double().exp().max(1)
    surplus = (choice == labels).double() - confidence
    assert abs(surplus.mean()) < 4 * surplus.std() / math.sqrt(len(labels))


def test_the_file_is_small_and_the_one_the_readme_describes():
    assert classifiers_path().stat().st_size <= 1_000_000
    assert CLASSIFIERS_SHA256 in classifiers_path().with_name("README.md").read_text("utf-8")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_file_is_refused(share, tmp_path, monkeypatch):
    content = classifiers_path().read_bytes()
    path = tmp_path / "classifiers.npz"
    path.write_bytes(content[: int(share * len(content))])
    monkeypatch.setattr(shipped, "classifiers_path", lambda: path)

    with pytest.raises(ForbesError, match=r"classifiers\.npz: truncated or not an \.npz file .* reinstall forbes"):
        load_classifiers("bundled")


def test_other_weights_and_a_missing_file_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "classifiers.npz"
    monkeypatch.setattr(shipped, "classifiers_path", lambda: path)

    with pytest.raises(ForbesError, match=r"classifiers\.npz: no such file\. Restore it"):
        load_classifiers("bundled")
    np.savez(path, finished=np.zeros(3, np.float16))
    with pytest.raises(ForbesError, match=rf"weights of sha256 .*, expected {CLASSIFIERS_SHA256[:16]}"):
        load_classifiers("bundled")


def test_a_classifier_sees_the_last_frame_and_the_mean_of_all():
    source = Strokes(frames="whole")
    index, time = torch.arange(20), 12
    frames = source.decode(source.gather("test", index, time)).observation.float()

    seen = digits_of(source, "test").take(index).histories(torch.full((20,), time))

    torch.testing.assert_close(seen[:, :1], frames[:, -1])
    torch.testing.assert_close(seen[:, 1:], frames.mean(1))


def test_calibration_takes_back_what_was_exaggerated(classifiers):
    validation = digits_of(Strokes(), "validation").take(torch.arange(500))
    classifier = load_classifiers("bundled").prefix
    calibrate(classifier, validation)
    before, _ = classify(classifier, validation, 10)
    with torch.no_grad():
        for parameter in classifier.net[-1].parameters():
            parameter.mul_(1.5)

    temperature = calibrate(classifier, validation)

    step = 2 ** (1 / 100)  # between two of the temperatures that are tried
    assert 1.5 / step <= temperature <= 1.5 * step
    after, _ = classify(classifier, validation, 10)
    torch.testing.assert_close(after.exp(), before.exp(), atol=step - 1, rtol=0)


def test_calibration_error_compares_confidence_with_accuracy():
    sure = torch.tensor([0.8, 0.2]).repeat(4, 1)
    unsure = torch.tensor([0.45, 0.55]).repeat(2, 1)

    assert calibration_error(sure, torch.tensor([0, 0, 1, 1])) == pytest.approx(0.3)  # float32 probabilities
    both, labels = torch.cat((sure, unsure)), torch.tensor([0, 0, 1, 1, 1, 1])
    assert calibration_error(both, labels) == pytest.approx((4 * 0.3 + 2 * 0.45) / 6)


def test_training_learns_and_is_a_function_of_the_seed():
    source = Strokes()
    train = digits_of(source, "train").take(torch.arange(1024))
    test = digits_of(source, "test").take(torch.arange(500))

    one, same, other = (fit_classifier(train, draw_finished, 4, seed) for seed in (0, 0, 1))

    assert quality(*classify(one, test, None)).accuracy > 0.1 + 5 * math.sqrt(0.1 * 0.9 / 500)  # chance
    weights = [torch.cat([values.flatten() for values in net.state_dict().values()]) for net in (one, same, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_the_command_builds_from_both_sets_and_reports_quality(strokes_file, tmp_path, monkeypatch, capsys):
    tiny = Strokes(path=str(strokes_file), validation=20)
    monkeypatch.setattr(commands, "Strokes", lambda origin: tiny)
    monkeypatch.setattr(commands, "_PREFIXES", (2, 3))
    monkeypatch.setattr(classifier_training, "_CALIBRATED", (2, 3))
    monkeypatch.setattr(classifier_training, "_BATCH", 4)
    path = tmp_path / "new" / "classifiers.npz"

    main(["build-classifiers", "-o", str(path)])

    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in lines[1:-1]] == [
        [name, origin, points]
        for origin in ("bundled", "dejong")
        for name, points in (("finished", "all"), (f"prefix-{origin}", "2"), (f"prefix-{origin}", "3"))
    ]
    sha256 = re.search(r"weights of sha256 (\w+), changed: put it into", lines[-1])[1]
    monkeypatch.setattr(shipped, "classifiers_path", lambda: path)
    monkeypatch.setattr(shipped, "CLASSIFIERS_SHA256", sha256)
    accuracy = quality(*classify(load_classifiers("dejong").prefix, digits_of(tiny, "test"), 3)).accuracy
    assert f"{accuracy:.4f}" in lines[-2]
