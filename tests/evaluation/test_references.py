"""References: models without a belief, on the same steps as what they are held against."""

import pytest
import torch

from forbes.data import SequenceBatch, SequenceDataModule, SequenceSource, Simulated, Strokes
from forbes.evaluation.references import references
from forbes.models import Bernoulli, Likelihood, Normal, OnePixel, VectorNormal
from forbes.pomdps import LinearGaussian


class Films(SequenceSource):
    """Bytes of 4 x 4 pixels, 3 training and 2 test films of 5 frames."""

    observation_shape = (1, 4, 4)
    action_dim = 0

    def sha256(self):
        return ""

    def size(self, split):
        return {"train": 3, "validation": 0, "test": 2}[split]

    def gather(self, split, index, length):
        seed = {"train": 0, "test": 1}[split]
        draw = torch.Generator().manual_seed(seed)
        return torch.randint(256, (self.size(split), length, 1, 4, 4), generator=draw, dtype=torch.uint8)[index]

    def decode(self, compact):
        batch, time = compact.shape[:2]
        none, mask = torch.zeros(batch, time), torch.ones(batch, time, dtype=torch.bool)
        mask[0, 3:] = False
        return SequenceBatch(compact, none[..., None][..., :0], none, mask, none[..., None][..., :0], ~mask)


class Motions(SequenceSource):
    """Positions of 40 training and 4 test trajectories under random forces, each with its own velocity."""

    observation_shape = (2,)
    action_dim = 2

    def sha256(self):
        return ""

    def size(self, split):
        return {"train": 40, "validation": 0, "test": 4}[split]

    def gather(self, split, index, length):
        draw = torch.Generator().manual_seed({"train": 0, "test": 1}[split])
        return torch.randn(self.size(split), length, 2, generator=draw)[index]

    def decode(self, compact):
        force = torch.cat((torch.zeros_like(compact[:, :1]), compact[:, 1:]), 1)  # no action leads to the first
        position = (compact[:, :1] + force.cumsum(1)).cumsum(1)
        batch, time = compact.shape[:2]
        none, mask = torch.zeros(batch, time), torch.ones(batch, time, dtype=torch.bool)
        return SequenceBatch(position, force, none, mask, none[..., None][..., :0], ~mask)


@pytest.mark.parametrize("frames", ["written", "whole"])
@pytest.mark.parametrize("likelihood", [OnePixel(), Bernoulli()], ids=["one pixel", "bernoulli"])
def test_strokes_have_the_same_n_grams_as_whole_frames(frames, likelihood, strokes_file):
    """Whole and written frames are a bijection, so a distribution gives both the same probability."""
    data, written = (
        SequenceDataModule(Strokes(path=str(strokes_file), validation=20, frames=kind), length=6)
        for kind in (frames, "written")
    )

    found = references(data, likelihood, "test", 12)

    assert [*found] == [f"{order}-gram" for order in range(1, 6)]
    for name, values in references(written, OnePixel(), "test", 12).items():
        assert torch.equal(found[name], values)


def test_a_density_of_strokes_is_not_held_against_n_grams(strokes_file):
    data = SequenceDataModule(Strokes(path=str(strokes_file), validation=20, frames="whole"), length=6)

    assert [*references(data, Normal(std=0.5), "test", 12)] == ["mean frame", "last frame"]


def test_n_grams_are_of_the_two_likelihoods_of_binary_pixels(strokes_file):
    own = type("Own", (Likelihood,), {name: lambda *_: None for name in Likelihood.__abstractmethods__})()
    data = SequenceDataModule(Strokes(path=str(strokes_file), validation=20), length=6)

    assert references(data, Bernoulli(), "test", 4)
    assert references(data, own, "test", 4) == {}


def test_images_are_held_against_still_pictures():
    data, likelihood = SequenceDataModule(Films(), length=5), Normal(std=0.5)

    found = references(data, likelihood, "test", 2)

    train, test = (data.sequences(split, torch.arange(n)) for split, n in (("train", 3), ("test", 2)))
    mean = likelihood.target(train.observation)[train.mask].mean(0)
    for row in range(2):
        for t in range(5):
            target = likelihood.target(test.observation[row, t])
            before = likelihood.target(test.observation[row, t - 1]) if t else mean
            for name, picture in (("mean frame", mean), ("last frame", before)):
                expected = likelihood.log_prob(picture, target).item() if test.mask[row, t] else 0
                assert found[name][row, t].item() == pytest.approx(expected, rel=1e-6)


def test_vectors_of_a_linear_process_are_predicted_without_error():
    data, likelihood = SequenceDataModule(Motions(), length=9), VectorNormal(std=0.1)

    found = references(data, likelihood, "test", 4)

    zero = likelihood.log_prob(torch.zeros(2), torch.zeros(2)).item()
    target = data.sequences("test", torch.arange(4)).observation
    torch.testing.assert_close(found["linear"][:, 2:], torch.full((4, 7), zero).double(), rtol=0, atol=1e-6)
    last = likelihood.log_prob(target[:, :-1], target[:, 1:]).double()
    torch.testing.assert_close(found["last observation"][:, 1:], last)
    means = {name: values.sum(1).mean() for name, values in found.items()}
    assert means["mean observation"] < means["last observation"] < means["linear"]


class Drift(Motions):
    """3,000 training sequences of one constant observation each, which grows from 0 to 1, as an agent's data change."""

    def size(self, split):
        return {"train": 3000, "validation": 0, "test": 2}[split]

    def gather(self, split, index, length):
        value = index / self.size("train") if split == "train" else torch.full((len(index),), 0.5)
        return value[:, None, None].expand(-1, length, 2)

    def decode(self, compact):
        return super().decode(compact)._replace(observation=compact)


def test_the_mean_is_of_the_whole_training_split_not_of_its_start():
    data = SequenceDataModule(Drift(), length=3)

    found = references(data, VectorNormal(), "test", 2)

    best = VectorNormal().log_prob(torch.full((2,), 0.5), torch.full((2,), 0.5)).double()
    torch.testing.assert_close(found["mean observation"], best.expand(2, 3), rtol=0, atol=1e-5)  # (1 / 1,000)²


def test_a_known_process_has_its_own_log_p():
    data = SequenceDataModule(Simulated(LinearGaussian(), train=10, validation=2, test=2), length=5)

    assert references(data, VectorNormal(), "test", 2) == {}


def test_other_data_have_none():
    assert references(SequenceDataModule(Films(), length=5), Bernoulli(), "test", 2) == {}


def test_references_of_coarse_pixels_are_always_the_same():
    data, likelihood = SequenceDataModule(Films(), length=5), Normal(bits=5)
    torch.manual_seed(1)
    after = torch.rand(1)

    torch.manual_seed(1)
    first = references(data, likelihood, "test", 2)

    assert torch.equal(torch.rand(1), after)  # the caller's noise is left alone
    again = references(data, likelihood, "test", 2)
    assert all(torch.equal(again[name], values) for name, values in first.items())
