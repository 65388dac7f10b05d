"""What is read of completions: of the truth, of one class only, of a blur, and of a digit that becomes another."""

import numpy as np
import pytest
import torch

from forbes.beliefs import GaussianBelief
from forbes.data import SequenceDataModule, Strokes
from forbes.data.strokes.classifiers import load_classifiers
from forbes.data.strokes.file import StrokeArrays, save_strokes
from forbes.errors import ForbesError
from forbes.evaluation.digits.completions import (
    model_pass,
    neighbour_pass,
    prefixes,
    score_completions,
    summarise,
    truth_pass,
)
from forbes.evaluation.digits.neighbours import Beginnings, last_frame, mean_frame
from forbes.evaluation.scoring import score_split
from forbes.models import Bernoulli, MLPDecoder, MLPEncoder, ModelParts, StateSpaceModel

CONTEXT, LENGTH = 5, 30


@pytest.fixture(scope="module")
def judges():
    return load_classifiers("bundled")


@pytest.fixture(scope="module")
def data():
    return SequenceDataModule(Strokes(frames="whole"), length=LENGTH)


@pytest.fixture(scope="module")
def beginnings(data, judges):
    return prefixes(data, "test", 20, CONTEXT, judges.prefix)


@pytest.fixture(scope="module")
def batch(data, beginnings):
    """Twenty test digits up to the end of the longest."""
    return data.sequences("test", beginnings.digits, int(beginnings.steps.max()))


@pytest.fixture
def model():
    torch.manual_seed(0)
    shape = (1, 28, 28)
    parts = ModelParts(
        belief=GaussianBelief,
        encoder=MLPEncoder(shape, 8, 1),
        decoder=MLPDecoder(4 + 2, shape, 8, 1, output_bias=-4.0),
        likelihood=Bernoulli(),
        action_dim=0,
        state_dim=2,
        hidden_dim=4,
        mlp_dim=8,
        mlp_layers=1,
    )
    return StateSpaceModel(parts).eval()


def repeated(batch, count):
    """The true digits as completions."""
    return batch.observation[:, CONTEXT:].float().expand(count, -1, -1, -1, -1, -1)


def test_the_prefixes_are_the_digits_that_go_on_in_the_order_of_their_length(data, judges):
    points = data.source.steps("test")[:20]
    context = int(points.sort().values[3])

    found = prefixes(data, "test", 20, context, judges.prefix)

    assert sorted(found.digits.tolist()) == [k for k in range(20) if points[k] > context]
    assert found.steps.tolist() == sorted(points[points > context].tolist())
    assert torch.equal(found.labels, data.source.labels("test")[found.digits])
    torch.testing.assert_close(
        found.reference.sum(1), torch.ones(len(found.digits), dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_too_few_digits_that_go_on_are_an_error(data, judges):
    longest = int(data.source.steps("test")[:20].max())
    with pytest.raises(ForbesError, match=rf"--prefixes {longest}: of 20 digits 0 go on after {longest} steps"):
        prefixes(data, "test", 20, longest, judges.prefix)


def test_a_model_that_completes_with_the_truth_scores_as_the_truth(model, data, beginnings, batch, judges):
    readings = score_completions(repeated(batch, 3), batch, CONTEXT, LENGTH, judges)
    truth = score_split(model, beginnings.batches(data, "test"), truth_pass(data, CONTEXT, judges)).values

    scores, expected = (summarise(each, beginnings, LENGTH) for each in (readings, truth))

    for name, values in expected.items():
        torch.testing.assert_close(scores[name], values, atol=1e-6, rtol=1e-5, msg=name)  # float32 in the classifiers
    for name in ("energy[end]", "energy[t<=30]", "crps[end]", "crps[t<=30]", "error[end]", "best[end]", "grey[end]"):
        assert scores[name].abs().max() == 0, name
    assert scores["clear[end]"].mean() >= 0.9
    assert scores["classes[end]"].median() == 1


def test_one_drawing_for_all_has_no_diversity_and_misses_the_label(batch, beginnings, judges):
    clear = score_completions(repeated(batch, 2), batch, CONTEXT, LENGTH, judges)["classes"].amax(1).argmax()
    end = int(batch.mask[clear].sum()) - 1
    drawing = batch.observation[clear, end].float().expand(2, len(batch.mask), batch.mask.shape[1] - CONTEXT, 1, -1, -1)

    scores = summarise(score_completions(drawing, batch, CONTEXT, LENGTH, judges), beginnings, LENGTH)

    assert scores["entropy[end]"].max() < 0.05
    assert (scores["classes[end]"] == 1).all()
    other = beginnings.labels != beginnings.labels[clear]
    assert (scores["nll[end]"][other] > 3).all()
    torch.testing.assert_close(scores["best[end]"], scores["error[end]"])
    torch.testing.assert_close(scores["average[end]"], scores["error[end]"])


def test_a_blur_of_all_digits_is_grey_and_not_clear(batch, judges):
    blur = repeated(batch, 2).mean(1, keepdim=True).expand(-1, len(batch.mask), -1, -1, -1, -1)

    readings = score_completions(blur, batch, CONTEXT, LENGTH, judges)

    assert readings["clear"].max() == 0
    assert readings["grey"].min() > 0.7


def test_a_completion_that_turns_into_another_digit_has_not_kept_its_class(batch, beginnings, judges):
    frames = repeated(batch, 2)
    kept = score_completions(frames, batch, CONTEXT, LENGTH, judges)
    place, end = torch.arange(len(batch.mask)), batch.mask.sum(1) - 1
    other = torch.stack([(beginnings.labels != label).nonzero()[0, 0] for label in beginnings.labels])
    turned = frames.clone()
    turned[:, place, end - CONTEXT] = batch.observation[other, end[other]].float()

    changed = score_completions(turned, batch, CONTEXT, LENGTH, judges)

    for share in (60, 80):
        torch.testing.assert_close(changed[f"early {share}"], kept[f"early {share}"])
        early = kept[f"early {share}"].sum()
        assert early >= 5
        assert kept[f"kept {share}"].sum() >= 0.9 * early
        assert changed[f"kept {share}"].sum() <= 0.1 * early


def test_nothing_after_the_end_of_a_digit_is_read(batch, judges):
    frames = repeated(batch, 2)
    beyond = ~batch.mask[:, CONTEXT:, None, None, None]

    def seeded(completions):
        torch.manual_seed(0)
        return score_completions(completions, batch, CONTEXT, LENGTH, judges)

    expected, found = seeded(frames), seeded(torch.where(beyond, 0.5, frames))

    for name, values in expected.items():
        assert torch.equal(found[name], values), name


def test_pixels_are_scored_at_the_last_step_of_the_training_too(batch, judges):
    wrong = repeated(batch, 2).clone()
    wrong[:, :, LENGTH - CONTEXT - 1, 0, 0, 0] = 1  # one pixel too many, at step 30

    readings = score_completions(wrong, batch, CONTEXT, LENGTH, judges)

    reached = (batch.mask.sum(1) >= LENGTH).double()
    assert 0 < reached.mean() < 1
    torch.testing.assert_close(readings["energy trained"][:, 0], reached)
    torch.testing.assert_close(readings["crps trained"][:, 0], reached)
    ends_there = (batch.mask.sum(1) == LENGTH).double()
    torch.testing.assert_close(readings["energy end"][:, 0], ends_there)


def test_a_models_completions_are_a_function_of_the_seed(model, data, judges):
    few = prefixes(data, "test", 3, CONTEXT, judges.prefix)

    def read(seed):
        return score_split(model, few.batches(data, "test"), model_pass(data, CONTEXT, 3, judges), seed).values

    one, same, other = read(0), read(0), read(1)

    for name, values in one.items():
        assert torch.equal(same[name], values), name
    assert not torch.equal(other["energy end"], one["energy end"])


def arrays_of(digits):
    """Digits of seven points in one stroke, of classes 0, 1, …"""
    points = np.array(digits, np.uint8).reshape(-1, 2)
    pen_up = np.tile(np.arange(7) == 6, len(digits))
    offsets = np.arange(0, len(points) + 1, 7, dtype=np.int32)
    return StrokeArrays(points, pen_up, offsets, np.arange(len(digits), dtype=np.uint8))


def test_only_the_mean_of_its_frames_tells_in_which_order_a_beginning_was_written(tmp_path):
    """Two training digits with the same first four pixels, written to the right and to the left, then three more."""
    right = [[x, 5] for x in (3, 8, 13, 18)]
    paths = [right + [[18, y] for y in (10, 15, 20)], right[::-1] + [[3, y] for y in (10, 15, 20)]]
    splits = {"train": paths, "test": paths[1:]}
    save_strokes(tmp_path / "strokes.npz", {split: arrays_of(digits) for split, digits in splits.items()})
    data = SequenceDataModule(Strokes(path=str(tmp_path / "strokes.npz"), validation=0), length=6)
    seen = data.source.pictures(data.sequences("test", torch.arange(1), 4).observation)

    assert Beginnings(data, 4, mean_frame).nearest(seen, 1).tolist() == [[1]]
    pictures = Beginnings(data, 4, last_frame).pictures
    assert torch.equal(pictures[0], pictures[1])


def test_similar_digits_stand_in_for_completions(model, data, beginnings, judges):
    """Digits of the training split are found for themselves first, and complete themselves without error."""
    few = prefixes(data, "train", 3, CONTEXT, judges.prefix)

    readings = score_split(model, few.batches(data, "train"), neighbour_pass(data, CONTEXT, 2, judges)).values

    assert readings["best"][:, -1].abs().max() == 0
    assert readings["grey"].abs().max() == 0


def test_written_strokes_are_read_as_whole_frames_are(model, data, beginnings, judges):
    written = SequenceDataModule(Strokes(frames="written"), length=LENGTH)

    few, same = (prefixes(each, "test", 3, CONTEXT, judges.prefix) for each in (data, written))

    assert torch.equal(few.reference, same.reference)
    for one in (truth_pass, lambda data, *rest: neighbour_pass(data, CONTEXT, 2, judges)):
        whole, added = (
            score_split(model, few.batches(each, "test"), one(each, CONTEXT, judges)).values for each in (data, written)
        )
        assert all(torch.equal(added[name], values) for name, values in whole.items())
