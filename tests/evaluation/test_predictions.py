"""Completions start from the belief after the prefix, and each goes its own way."""

import pytest
import torch

from forbes.beliefs import FlowBelief
from forbes.data import SequenceDataModule, Strokes
from forbes.errors import ForbesError
from forbes.evaluation.predictions import complete, filter, first_of_each_class, imagine, whole_sequences
from forbes.models import Bernoulli, MLPDecoder, MLPEncoder, ModelParts, OnePixel, Rollout, StateSpaceModel


@pytest.fixture
def data(strokes_file):
    return SequenceDataModule(Strokes(path=str(strokes_file), validation=20, frames="whole"), batch_size=4, length=6)


@pytest.fixture
def model():
    torch.manual_seed(0)
    shape = (1, 28, 28)
    parts = ModelParts(
        belief=FlowBelief,
        encoder=MLPEncoder(shape, 8, 1),
        decoder=MLPDecoder(4 + 2, shape, 8, 1),
        likelihood=Bernoulli(),
        action_dim=1,
        state_dim=2,
        hidden_dim=4,
        mlp_dim=8,
        mlp_layers=1,
    )
    return StateSpaceModel(parts).eval()


@pytest.fixture
def batch(data):
    """Five digits of nine steps, with an action of their own at each."""
    action = torch.randn(5, 9, 1, generator=torch.Generator().manual_seed(0))
    return data.sequences("test", torch.arange(5), 9)._replace(action=action)


def seeded(model, data, batch, samples=3):
    torch.manual_seed(0)
    return complete(model, data.source, batch, 4, samples)


def test_a_completion_has_a_frame_for_each_unseen_step(model, data, batch):
    completions = seeded(model, data, batch)

    assert completions.frames.shape == (3, 5, 5, 1, 28, 28)
    assert completions.frames.min() >= 0
    assert completions.frames.max() <= 1
    assert torch.equal(completions.at(5), completions.frames[:, :, 0])
    assert torch.equal(completions.at(9), completions.frames[:, :, -1])
    for time in (0, 4, 10):
        with pytest.raises(ForbesError, match=f"step {time} was not completed, expected 5 to 9"):
            completions.at(time)


def test_a_completion_knows_the_prefix_and_nothing_else(model, data, batch):
    future = batch.observation.clone()
    future[:, 4:] = 1 - future[:, 4:]
    past = batch.observation.clone()
    past[:, :4] = 1 - past[:, :4]

    frames = seeded(model, data, batch).frames

    assert torch.equal(seeded(model, data, batch._replace(observation=future)).frames, frames)
    assert not torch.equal(seeded(model, data, batch._replace(observation=past)).frames, frames)


def test_to_complete_is_to_filter_imagine_and_decode(model, data, batch):
    beginning, future = (batch._replace(**fields(batch, steps)) for steps in (slice(4), slice(4, None)))

    torch.manual_seed(0)
    rollout = imagine(model, filter(model, beginning, samples=3), future.action)
    frames = model.likelihood.mean(model.decode(rollout.features))  # (N B, T - c, C, H, W)

    assert torch.equal(frames.unflatten(0, (3, 5)), seeded(model, data, batch).frames)


def fields(batch, steps):
    return {name: getattr(batch, name)[:, steps] for name in ("observation", "action", "mask")}


def test_belief_samples_follow_the_actions_of_their_sequence(model, batch):
    belief = filter(model, batch, samples=2)
    assert belief.hidden.shape == (10, 4)
    assert belief.state.shape == (10, 2)

    rollout = imagine(model, belief, batch.action)

    hidden = model.gru(model.transition(torch.cat((belief.state[7], batch.action[2, 0]))), belief.hidden[7])
    torch.testing.assert_close(rollout.hidden[7, 0], hidden)  # the second sample of the third sequence
    assert not rollout.state.requires_grad


def test_a_belief_that_does_not_match_the_actions_is_refused(model, batch):
    belief = filter(model, batch, samples=2)

    with pytest.raises(ForbesError, match="the belief has 10 rows, expected a multiple of the 4 sequences of action"):
        imagine(model, belief, batch.action[:4])


def test_samples_of_one_prefix_differ(model, data, batch):
    frames = seeded(model, data, batch, samples=4).frames
    assert len(frames.flatten(1).unique(dim=0)) == 4


def test_a_sample_keeps_its_own_trajectory(model, data, batch):
    """Rolling on the n-th belief alone gives the n-th completion: rows never mix."""
    # Without the prior's noise the rest of a trajectory is a function of its start.
    model.prior.rsample = lambda context, sample_shape=(): (context[:, :2], context[:, 0])
    model.prior.sampler = lambda *bind: model.prior.rsample

    together = seeded(model, data, batch)

    with torch.no_grad():
        torch.manual_seed(0)
        starts = model.sample_beliefs(model.encode(batch.observation[:, :4], batch.action[:, :4]), 3)
        for n in range(3):
            for b in range(5):
                row = n * 5 + b
                start = type(starts)(starts.hidden[row : row + 1], starts.state[row : row + 1])
                alone = model.decode(model.imagine(start, batch.action[b : b + 1, 4:]).features).sigmoid()
                torch.testing.assert_close(together.frames[n, b], alone[0])


def test_whole_sequences_reach_the_longest_and_the_data_length(data):
    index = torch.arange(12)
    points = torch.from_numpy(data.source.arrays("test").offsets).diff()

    batch = whole_sequences(data, "test", index)
    assert batch.observation.shape[1] == points.max() > data.length
    assert batch.mask.sum(1).tolist() == points.tolist()

    shortest = points.argmin()[None]
    assert whole_sequences(data, "test", shortest).observation.shape[1] == max(points.min(), data.length)


def test_whole_sequences_without_an_end_have_the_data_length(strokes_file):
    source = Strokes(path=str(strokes_file), validation=20, frames="whole", end="observed")
    data = SequenceDataModule(source, batch_size=4, length=6)
    assert whole_sequences(data, "test", torch.arange(2)).observation.shape[1] == 6


@pytest.mark.parametrize("count", [3, 10, 15])
def test_digits_are_chosen_class_by_class_and_in_order(data, count):
    labels = data.source.labels("validation")

    chosen = first_of_each_class(data, "validation", count)

    assert labels[chosen].tolist() == [*range(10), *range(10)][:count]
    first = {label: labels.tolist().index(label) for label in range(10)}
    assert chosen[:10].tolist() == [first[label] for label in range(10)][:count]


@pytest.fixture(name="written")
def written_fixture(strokes_file):
    return SequenceDataModule(Strokes(path=str(strokes_file), validation=20), batch_size=4, length=6)


def test_a_completion_of_written_strokes_is_a_drawing(model, written, batch):
    seen = written.sequences("test", torch.arange(5), 9)._replace(action=batch.action)
    model.likelihood = OnePixel()

    frames = seeded(model, written, seen).frames  # (3, 5, 5, 1, 28, 28)

    beginning = written.source.pictures(seen.observation)[:, 3]
    assert set(frames.unique().tolist()) == {0.0, 1.0}
    assert (frames[:, :, 0] >= beginning).all()
    steps = torch.cat((beginning.expand(3, 1, *beginning.shape).transpose(1, 2), frames), 2).diff(dim=2)
    assert steps.min() == 0
    assert steps.flatten(3).sum(-1).max() == 1  # one pixel a step


def test_the_mean_of_a_completion_is_that_of_many_drawings(model, written, batch):
    """Along the same trajectory; drawings differ in what they draw there."""
    seen = written.sequences("test", torch.arange(1), 9)._replace(action=batch.action[:1])
    model.likelihood, model.prior.min_std, number = OnePixel(), 0.1, 4000
    start = model.sample_beliefs(model.encode(seen.observation[:, :4], seen.action[:, :4]), 1)
    rollout = model.imagine(start, seen.action[:, 4:])
    model.sample_beliefs = lambda seen, samples: start
    model.imagine = lambda start, action: Rollout(*(values.repeat_interleave(len(action), 0) for values in rollout))

    torch.manual_seed(0)
    drawn = complete(model, written.source, seen, 4, number).frames.mean(0)
    mean = complete(model, written.source, seen, 4, 1, mean=True).frames[0]

    error = (mean * (1 - mean) / number).sqrt().clamp(min=1e-4)
    # Of 5 x 784 binomial shares, the largest |z| exceeds 6 with probability 1e-5.
    assert ((drawn - mean) / error).abs().max() < 6
