"""What is read of completions: of the truth, of one class only, of a blur, and of a digit that becomes another."""

from functools import partial

import numpy as np
import pytest
import torch

from forbes.beliefs import GaussianBelief
from forbes.data import SequenceDataModule, Strokes
from forbes.data.strokes.classifiers import load_classifiers
from forbes.data.strokes.file import StrokeArrays, save_strokes
from forbes.errors import ForbesError
from forbes.evaluation.digits.completions import (
    model_scorer,
    neighbour_scorer,
    ngram_scorer,
    score_completions,
    select_prefixes,
    summarise,
    truth_scorer,
)
from forbes.evaluation.digits.neighbours import TrainingPrefixes, last_frame, mean_frame
from forbes.evaluation.scoring import score_split
from forbes.models import Bernoulli, MLPDecoder, MLPEncoder, ModelParts, StateSpaceModel

CONTEXT, LENGTH = 5, 30
FEW = {"validation": 59_000}  # a thousand digits to train on


@pytest.fixture(scope="module")
def classifiers():
    return load_classifiers("bundled")


@pytest.fixture(scope="module")
def data():
    return SequenceDataModule(Strokes(frames="whole", **FEW), length=LENGTH)


@pytest.fixture(scope="module")
def prefixes(data, classifiers):
    return select_prefixes(data, "test", 20, CONTEXT, classifiers.prefix)


@pytest.fixture(scope="module")
def batch(data, prefixes):
    """Twenty test digits up to the end of the longest."""
    return data.sequences("test", prefixes.digits, int(prefixes.steps.max()))


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


def test_prefixes_are_of_digits_that_continue_sorted_by_length(data, classifiers):
    points = data.source.steps("test")[:20]
    context = int(points.sort().values[3])

    found = select_prefixes(data, "test", 20, context, classifiers.prefix)

    assert sorted(found.digits.tolist()) == [k for k in range(20) if points[k] > context]
    assert found.steps.tolist() == sorted(points[points > context].tolist())
    assert torch.equal(found.labels, data.source.labels("test")[found.digits])
    torch.testing.assert_close(
        found.reference.sum(1), torch.ones(len(found.digits), dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_digits_end_where_they_do_also_if_models_observe_their_end(classifiers, prefixes):
    observed = SequenceDataModule(Strokes(frames="whole", end="observed", **FEW), length=LENGTH)
    chosen = select_prefixes(observed, "test", 20, CONTEXT, classifiers.prefix)

    steps = [batch.mask.sum(1) for _, batch in chosen.batches(observed, "test")]
    assert torch.equal(torch.cat(steps), prefixes.steps)


def test_too_few_digits_that_continue_are_an_error(data, classifiers):
    longest = int(data.source.steps("test")[:20].max())
    with pytest.raises(ForbesError, match=rf"--prefixes {longest}: of 20 digits 0 continue after {longest} steps"):
        select_prefixes(data, "test", 20, longest, classifiers.prefix)


def test_completing_with_the_truth_scores_as_the_truth(model, data, prefixes, batch, classifiers):
    readings = score_completions(repeated(batch, 3), batch, CONTEXT, LENGTH, classifiers)
    truth = score_split(model, prefixes.batches(data, "test"), truth_scorer(data, CONTEXT, classifiers)).values

    scores, expected = (summarise(each, prefixes, LENGTH) for each in (readings, truth))

    for name, values in expected.items():
        torch.testing.assert_close(scores[name], values, atol=1e-6, rtol=1e-5, msg=name)  # float32 in the classifiers
    for name in ("energy[end]", "energy[t<=30]", "crps[end]", "crps[t<=30]", "error[end]", "best[end]", "grey[end]"):
        assert scores[name].abs().max() == 0, name
    assert scores["clear[end]"].mean() >= 0.9
    assert scores["classes[end]"].median() == 1


def test_one_drawing_for_all_is_not_diverse_and_misses_labels(batch, prefixes, classifiers):
    clear = score_completions(repeated(batch, 2), batch, CONTEXT, LENGTH, classifiers)["classes"].amax(1).argmax()
    end = int(batch.mask[clear].sum()) - 1
    drawing = batch.observation[clear, end].float().expand(2, len(batch.mask), batch.mask.shape[1] - CONTEXT, 1, -1, -1)

    scores = summarise(score_completions(drawing, batch, CONTEXT, LENGTH, classifiers), prefixes, LENGTH)

    assert scores["entropy[end]"].max() < 0.05
    assert (scores["classes[end]"] == 1).all()
    other = prefixes.labels != prefixes.labels[clear]
    assert (scores["nll[end]"][other] > 3).all()
    torch.testing.assert_close(scores["best[end]"], scores["error[end]"])
    torch.testing.assert_close(scores["average[end]"], scores["error[end]"])


def test_a_blur_of_all_digits_is_grey_and_not_clear(batch, classifiers):
    blur = repeated(batch, 2).mean(1, keepdim=True).expand(-1, len(batch.mask), -1, -1, -1, -1)

    readings = score_completions(blur, batch, CONTEXT, LENGTH, classifiers)

    assert readings["clear"].max() == 0
    assert readings["grey"].min() > 0.7


def test_clear_digits_are_also_counted_among_those_that_end_within_the_training_length(batch, prefixes, classifiers):
    frames = repeated(batch, 2).clone()
    place, end = torch.arange(len(batch.mask)), batch.mask.sum(1) - 1
    length = int(prefixes.steps.median())
    long = prefixes.steps > length
    frames[:, place[long], end[long] - CONTEXT] = frames[0, :, -1].mean(0)  # long ones end as a blur of all

    readings = score_completions(frames, batch, CONTEXT, LENGTH, classifiers)

    truth = score_completions(repeated(batch, 2), batch, CONTEXT, LENGTH, classifiers)["clear"][~long]
    torch.testing.assert_close(summarise(readings, prefixes, length)[f"clear[n<={length}]"].mean(), truth.mean())
    assert summarise(readings, prefixes, length)["clear[end]"].mean() == pytest.approx(truth.sum().item() / len(long))
    assert summarise(readings, prefixes, CONTEXT)[f"clear[n<={CONTEXT}]"].isnan().all()  # none ends so early


def test_turning_into_another_digit_does_not_keep_the_class(batch, prefixes, classifiers):
    frames = repeated(batch, 2)
    kept = score_completions(frames, batch, CONTEXT, LENGTH, classifiers)
    place, end = torch.arange(len(batch.mask)), batch.mask.sum(1) - 1
    other = torch.stack([(prefixes.labels != label).nonzero()[0, 0] for label in prefixes.labels])
    turned = frames.clone()
    turned[:, place, end - CONTEXT] = batch.observation[other, end[other]].float()

    changed = score_completions(turned, batch, CONTEXT, LENGTH, classifiers)

    for share in (60, 80):
        torch.testing.assert_close(changed[f"early {share}"], kept[f"early {share}"])
        early = kept[f"early {share}"].sum()
        assert early >= 5
        assert kept[f"kept {share}"].sum() >= 0.9 * early
        assert changed[f"kept {share}"].sum() <= 0.1 * early


def test_nothing_after_the_end_of_a_digit_is_read(batch, classifiers):
    frames = repeated(batch, 2)
    beyond = ~batch.mask[:, CONTEXT:, None, None, None]

    def seeded(completions):
        torch.manual_seed(0)
        return score_completions(completions, batch, CONTEXT, LENGTH, classifiers)

    expected, found = seeded(frames), seeded(torch.where(beyond, 0.5, frames))

    for name, values in expected.items():
        assert torch.equal(found[name], values), name


def test_pixels_are_scored_at_the_last_step_of_the_training_too(batch, classifiers):
    wrong = repeated(batch, 2).clone()
    wrong[:, :, LENGTH - CONTEXT - 1, 0, 0, 0] = 1  # one pixel too many, at step 30

    readings = score_completions(wrong, batch, CONTEXT, LENGTH, classifiers)

    reached = (batch.mask.sum(1) >= LENGTH).double()
    assert 0 < reached.mean() < 1
    torch.testing.assert_close(readings["energy trained"][:, 0], reached)
    torch.testing.assert_close(readings["crps trained"][:, 0], reached)
    ends_there = (batch.mask.sum(1) == LENGTH).double()
    torch.testing.assert_close(readings["energy end"][:, 0], ends_there)


def test_a_models_completions_are_a_function_of_the_seed(model, data, classifiers):
    few = select_prefixes(data, "test", 3, CONTEXT, classifiers.prefix)

    def read(seed):
        return score_split(model, few.batches(data, "test"), model_scorer(data, CONTEXT, 3, classifiers), seed).values

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


def test_only_the_mean_frame_tells_the_order_of_writing(tmp_path):
    """Two training digits with the same first four pixels, written to the right and to the left, then three more."""
    right = [[x, 5] for x in (3, 8, 13, 18)]
    paths = [right + [[18, y] for y in (10, 15, 20)], right[::-1] + [[3, y] for y in (10, 15, 20)]]
    splits = {"train": paths, "test": paths[1:]}
    save_strokes(tmp_path / "strokes.npz", {split: arrays_of(digits) for split, digits in splits.items()})
    data = SequenceDataModule(Strokes(path=str(tmp_path / "strokes.npz"), validation=0), length=6)
    seen = data.source.pictures(data.sequences("test", torch.arange(1), 4).observation)

    assert TrainingPrefixes(data, 4, mean_frame).nearest(seen, 1).tolist() == [[1]]
    pictures = TrainingPrefixes(data, 4, last_frame).pictures
    assert torch.equal(pictures[0], pictures[1])


def test_similar_digits_stand_in_for_completions(model, data, prefixes, classifiers):
    """Digits of the training split are found for themselves first, and complete themselves without error."""
    few = select_prefixes(data, "train", 3, CONTEXT, classifiers.prefix)

    readings = score_split(model, few.batches(data, "train"), neighbour_scorer(data, CONTEXT, 2, classifiers)).values

    assert readings["best"][:, -1].abs().max() == 0
    assert readings["grey"].abs().max() == 0


@pytest.mark.parametrize("points_per_step", [1, 2])
def test_an_ngram_draws_on_from_what_was_seen(model, classifiers, points_per_step):
    data = SequenceDataModule(Strokes(points_per_step=points_per_step, frames="written", **FEW), length=LENGTH)
    few = select_prefixes(data, "test", 6, CONTEXT, classifiers.prefix)
    shorter = few._replace(steps=few.steps.clamp(max=CONTEXT + 1))  # of which one step is drawn

    def readings(prefixes):
        scorer = ngram_scorer(data, CONTEXT, 20, classifiers)
        return summarise(score_split(model, prefixes.batches(data, "test"), scorer).values, prefixes, LENGTH)

    whole, one_step = readings(few), readings(shorter)
    assert whole["grey[end]"].abs().max() == 0
    assert one_step["error[end]"].max() <= 2 * points_per_step  # so many pixels are not those of the truth
    assert 0 < one_step["error[end]"].mean() < whole["error[end]"].mean()


def test_written_strokes_are_read_as_whole_frames_are(model, data, prefixes, classifiers):
    written = SequenceDataModule(Strokes(frames="written", **FEW), length=LENGTH)

    few, same = (select_prefixes(each, "test", 3, CONTEXT, classifiers.prefix) for each in (data, written))

    assert torch.equal(few.reference, same.reference)
    drawn = (partial(scorer, samples=2) for scorer in (neighbour_scorer, ngram_scorer))
    for one in (truth_scorer, *drawn):
        whole, added = (
            score_split(model, few.batches(each, "test"), one(each, CONTEXT, classifiers=classifiers)).values
            for each in (data, written)
        )
        assert all(torch.equal(added[name], values) for name, values in whole.items())
