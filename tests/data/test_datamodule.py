"""The DataModule: which sequences are in which batch, whatever happened before."""

from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from forbes.data import SequenceBatch, SequenceDataModule, SequenceSource, Simulated
from forbes.errors import ForbesError
from forbes.pomdps import Tiger


class Compact(NamedTuple):
    index: Tensor
    length: int


class Numbers(SequenceSource):
    """Sequence i shows the number i in every frame."""

    observation_shape = (1, 2, 2)
    action_dim = 3

    def sha256(self):
        return "0" * 64

    def size(self, split):
        return {"train": 23, "validation": 7, "test": 10}[split]

    def gather(self, split, index, length):
        return Compact(index, length)

    def decode(self, compact):
        index, length = compact
        batch = len(index)
        return SequenceBatch(
            index.to(torch.uint8).view(-1, 1, 1, 1, 1).expand(batch, length, *self.observation_shape),
            torch.zeros(batch, length, self.action_dim),
            torch.zeros(batch, length),
            torch.ones(batch, length, dtype=torch.bool),
            torch.zeros(batch, length, 0),
            torch.zeros(batch, length, dtype=torch.bool),
        )


def module(**options):
    return SequenceDataModule(Numbers(), **{"batch_size": 5, "length": 4, "updates_per_epoch": 6, **options})


def indices(loader):
    """The indices of each batch."""
    return [compact.index.tolist() for compact in loader]


def in_order(loader):
    """The indices of all batches, one after the other."""
    return torch.cat([compact.index for compact in loader]).tolist()


def test_a_batch_depends_on_seed_and_update_only():
    forwards, backwards = module(seed=3), module(seed=3)

    one = [forwards.train_index(update).tolist() for update in range(12)]
    other = [backwards.train_index(update).tolist() for update in reversed(range(12))]

    assert one == other[::-1]
    assert one != [module(seed=4).train_index(update).tolist() for update in range(12)]


def test_a_pass_repeats_no_sequence_and_the_next_is_reordered():
    data, batches = module(), 23 // 5

    passes = [torch.cat([data.train_index(turn * batches + k) for k in range(batches)]) for turn in range(50)]

    assert all(len(order.unique()) == batches * 5 for order in passes)
    assert not torch.equal(passes[0], passes[1])
    # The three sequences a pass leaves out are others each time: 50 passes miss one with probability (3/23)^50.
    assert torch.cat(passes).unique().tolist() == list(range(23))


def trainer_after(batches, of_this_epoch=0, overfit_batches=0.0):
    """A trainer that has taken so many training batches; its loop has the index of the last."""
    loop = SimpleNamespace(total_batch_idx=batches - 1, batch_idx=of_this_epoch - 1)
    return SimpleNamespace(fit_loop=loop, overfit_batches=overfit_batches)


def test_an_epoch_continues_after_the_batches_already_taken():
    data = module()
    whole = [data.train_index(update).tolist() for update in range(18)]

    epochs = []
    for batches in (0, 6, 9):
        data.trainer = trainer_after(batches)
        loader = data.train_dataloader()
        assert len(loader) == 6
        epochs.append(indices(loader))

    assert epochs == [whole[:6], whole[6:12], whole[9:15]]


def test_overfitting_takes_the_same_batches_in_every_epoch():
    data = module()
    whole = [data.train_index(update).tolist() for update in range(12)]

    epochs = []
    for batches, of_this_epoch in ((0, 0), (6, 0), (8, 2)):
        data.trainer = trainer_after(batches, of_this_epoch, overfit_batches=2)
        epochs.append(indices(data.train_dataloader()))

    assert epochs == [whole[:6], whole[:6], whole[2:8]]


def test_the_trainers_batches_are_counted_when_an_epoch_begins():
    data = module()
    data.trainer = trainer_after(0)
    loader = data.train_dataloader()

    first = indices(loader)
    data.trainer = trainer_after(6)

    assert indices(loader) == [data.train_index(update).tolist() for update in range(6, 12)]
    assert first == [data.train_index(update).tolist() for update in range(6)]


@pytest.mark.parametrize(("limit", "expected"), [(3, [0, 1, 2]), (1000, list(range(7)))])
def test_validation_takes_the_first_sequences_in_order(limit, expected):
    assert in_order(module(validation_sequences=limit).val_dataloader()) == expected


def test_test_and_prediction_take_the_whole_split_in_order():
    data = module(batch_size=2)

    assert in_order(data.test_dataloader()) == list(range(10))
    assert in_order(data.predict_dataloader()) == list(range(10))


def test_batches_are_decoded_on_the_device_and_not_before():
    data = module()
    compact = next(iter(data.train_dataloader()))

    batch = data.on_after_batch_transfer(compact, 0)

    assert isinstance(compact, Compact)
    assert batch.observation.dtype == torch.uint8
    assert batch.observation.shape == (5, 4, 1, 2, 2)
    assert batch.observation[:, 0, 0, 0, 0].tolist() == data.train_index(0).tolist()


def test_chosen_sequences_come_in_the_length_asked_for():
    data = module()

    assert data.sequences("test", torch.tensor([4, 2])).observation.shape == (2, 4, 1, 2, 2)
    assert data.sequences("test", torch.tensor([4, 2]), length=9).observation[:, 8].flatten(1)[:, 0].tolist() == [4, 2]


def test_gives_the_shapes_of_its_source():
    assert module().observation_shape == (1, 2, 2)
    assert module().action_dim == 3


@pytest.mark.parametrize("name", ["batch_size", "length", "updates_per_epoch", "validation_sequences"])
@pytest.mark.parametrize("value", [0, -1])
def test_refuses_less_than_one(name, value):
    with pytest.raises(ForbesError, match=f"{name} is {value}, expected at least 1"):
        module(**{name: value})


def test_refuses_a_batch_that_is_larger_than_the_split():
    with pytest.raises(ForbesError, match="batch_size is 24, but the training split has 23 sequences"):
        module(batch_size=24).train_index(0)
    assert len(module(batch_size=23).train_index(0)) == 23


class Own(Simulated):
    """A source of a user, right but for what a test changes."""

    def __init__(self, change):
        super().__init__(Tiger(), 4, 4, 4)
        self.change = change

    def decode(self, compact):
        return self.change(super().decode(compact))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda batch: tuple(batch), "decode returns a tuple, expected a SequenceBatch"),
        (
            lambda batch: batch._replace(observation=batch.observation.double()),
            "decode returns observation float64 (2, 3, 2), expected float32 (2, 3, 2)",
        ),
        (
            lambda batch: batch._replace(observation=batch.observation[..., :1]),
            "observation float32 (2, 3, 1), expected float32 (2, 3, 2). Change decode, or observation_shape",
        ),
        (lambda batch: batch._replace(action=batch.action[..., :0]), "action float32 (2, 3, 0), expected float32"),
        (lambda batch: batch._replace(reward=batch.reward[..., None]), "reward float32 (2, 3, 1), expected"),
        (lambda batch: batch._replace(mask=batch.mask.float()), "mask float32 (2, 3), expected bool (2, 3)"),
        (lambda batch: batch._replace(ended=batch.ended[:, 1:]), "ended bool (2, 2), expected bool (2, 3)"),
    ],
)
def test_what_a_source_gives_is_checked_with_its_first_batch(change, sentence):
    data = SequenceDataModule(Own(change), batch_size=2, length=3)

    with pytest.raises(ForbesError) as error:
        data.sequences("train", torch.arange(2))
    assert str(error.value).startswith("Own: ")
    assert sentence in str(error.value)


@pytest.mark.parametrize("name", ["observation_shape", "action_dim"])
def test_a_source_without_its_shapes_is_refused_at_once(name):
    source = Own(lambda batch: batch)
    SequenceDataModule(source)
    delattr(source, name)

    with pytest.raises(ForbesError, match=f"Own: it has no {name}, expected"):
        SequenceDataModule(source)
