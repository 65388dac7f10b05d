"""Sequences of known processes as data."""

import pytest
import torch

from forbes.data import SequenceDataModule, Simulated
from forbes.errors import ForbesError
from forbes.pomdps import LinearGaussian, MountainHike


def source(**options):
    return Simulated(MountainHike(), train=20, validation=5, test=6, **options)


def test_a_batch_holds_the_chosen_sequences_of_the_process():
    data = source()
    drawn = data.trajectories("test", 4)

    batch = data.decode(data.gather("test", torch.tensor([3, 1]), 4))

    torch.testing.assert_close(batch.observation, drawn.observation[[3, 1]].float(), rtol=0, atol=0)
    torch.testing.assert_close(batch.action, drawn.action[[3, 1]].float(), rtol=0, atol=0)
    torch.testing.assert_close(batch.state, drawn.state[[3, 1]].float(), rtol=0, atol=0)
    assert batch.observation.shape == (2, 4, *data.observation_shape)
    assert batch.action.shape == (2, 4, data.action_dim)
    assert batch.mask.all()
    assert not batch.reward.any()


def test_splits_and_seeds_have_sequences_of_their_own_and_the_same_each_time():
    first = {split: source().trajectories(split, 3).observation for split in ("train", "validation", "test")}
    again = source().trajectories("test", 3).observation

    assert [len(first[split]) for split in ("train", "validation", "test")] == [20, 5, 6]
    assert torch.equal(first["test"], again)
    assert not torch.equal(first["test"][:5], first["validation"])
    assert not torch.equal(source(seed=1).trajectories("test", 3).observation, again)


def test_the_hash_tells_processes_numbers_and_seeds_apart():
    hashes = {
        data.sha256()
        for data in (
            source(),
            source(seed=1),
            Simulated(MountainHike(), train=21, validation=5, test=6),
            Simulated(LinearGaussian(), train=20, validation=5, test=6),
            Simulated(LinearGaussian(transition_variance=0.1), train=20, validation=5, test=6),
        )
    }
    assert len(hashes) == 5
    assert source().sha256() in hashes


def test_it_feeds_the_datamodule():
    data = SequenceDataModule(source(), batch_size=4, length=3)
    batch = data.sequences("train", data.train_index(0))
    assert batch.observation.shape == (4, 3, 2)
    assert batch.observation.dtype == batch.action.dtype == torch.float32


def test_an_empty_split_is_named():
    with pytest.raises(ForbesError, match=r"Simulated: test is 0, expected at least 1"):
        Simulated(MountainHike(), test=0)
