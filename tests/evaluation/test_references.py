"""References: models without a belief, on the same steps as what they are held against."""

import pytest
import torch

from forbes.data import SequenceBatch, SequenceDataModule, SequenceSource, Strokes
from forbes.evaluation.references import references
from forbes.models import Bernoulli, Normal, OnePixel


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


def test_strokes_have_n_grams_under_any_likelihood(strokes_file):
    data = SequenceDataModule(Strokes(path=str(strokes_file), validation=20), length=6)

    found = [references(data, likelihood, "test", 12) for likelihood in (OnePixel(), Bernoulli())]

    assert [*found[0]] == [*found[1]] == [f"{order}-gram" for order in range(1, 6)]
    assert all(torch.equal(found[0][name], values) for name, values in found[1].items())


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
