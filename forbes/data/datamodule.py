"""The DataModule: batches of sequences from any source, each a pure function of (seed, update)."""

from collections.abc import Iterator
from typing import Any

import torch
from lightning import LightningDataModule, Trainer
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from forbes.data.source import SequenceBatch, SequenceSource, Split, check_batch, check_source
from forbes.errors import require_at_least

__all__ = ["SequenceDataModule"]


class _Batches(IterableDataset[Any]):
    """Compact batches of a split, from a list of indices per batch."""

    def __init__(self, source: SequenceSource, split: Split, length: int, indices: Any) -> None:
        self.source, self.split, self.length, self.indices = source, split, length, indices

    def __iter__(self) -> Iterator[Any]:
        for index in self.indices:  # lazily: when the iterator is made, the trainer may not know its update yet
            yield self.source.gather(self.split, index, self.length)

    def __len__(self) -> int:
        return len(self.indices)


class _TrainIndices:
    """Indices of an epoch's batches, chosen by the source: those after the ones that the trainer has taken."""

    def __init__(self, datamodule: "SequenceDataModule") -> None:
        self.datamodule = datamodule

    def __iter__(self) -> Iterator[Tensor]:
        trainer = self.datamodule.trainer
        first = _batches_taken(trainer) if trainer is not None else 0
        return (self.datamodule.train_index(number) for number in range(first, first + len(self)))

    def __len__(self) -> int:
        return self.datamodule.updates_per_epoch


def _batches_taken(trainer: Trainer) -> int:
    """Count the training batches so far; with `overfit_batches` those of this epoch, since all epochs share theirs."""
    loop, same = trainer.fit_loop, trainer.overfit_batches  # type: ignore[attr-defined]  # set by a helper of Lightning
    return 1 + (loop.batch_idx if same else loop.total_batch_idx)


class SequenceDataModule(LightningDataModule):
    """Batches of `SequenceBatch` from a source; images stay uint8 until they are on the device.

    Batch i of the training is a pure function of (seed, i): a resumed run goes on with the batch it would have had,
    and no loader or RNG state is stored. An epoch is a number of updates, not a pass over the data.

    Args:
        source: where the sequences come from, e.g. `Strokes`.
        batch_size: B.
        length: T; sequences are cut or padded to it.
        updates_per_epoch: batches between two validations and checkpoints.
        seed: of the order of the training batches.
        validation_sequences: how many of the validation split are used after each epoch, from its beginning.

    Raises:
        ForbesError: when `length` or `batch_size` is below 1, or a batch is larger than its split.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), batch_size=4, length=30)
        >>> compact = next(iter(data.train_dataloader()))
        >>> data.on_after_batch_transfer(compact, 0).observation.shape
        torch.Size([4, 30, 1, 28, 28])
    """

    def __init__(
        self,
        source: SequenceSource,
        batch_size: int = 50,
        length: int = 50,
        updates_per_epoch: int = 100,
        seed: int = 0,
        validation_sequences: int = 1000,
    ) -> None:
        super().__init__()
        sizes = {"batch_size": batch_size, "length": length, "updates_per_epoch": updates_per_epoch}
        require_at_least(1, "SequenceDataModule", **sizes, validation_sequences=validation_sequences)
        check_source(source)
        self.source, self.batch_size, self.length, self.seed = source, batch_size, length, seed
        self.updates_per_epoch = updates_per_epoch
        self.validation_sequences = validation_sequences

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of one observation."""
        return self.source.observation_shape

    @property
    def action_dim(self) -> int:
        """A."""
        return self.source.action_dim

    @property
    def discrete(self) -> bool:
        """Whether an action is one of A, as a one-hot vector."""
        return self.source.discrete

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint must hold for the same batches: how far a growing source was read."""
        return {} if self.source.watermark is None else {"watermark": self.source.watermark}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See the sequences that there were at the checkpoint."""
        self.source.watermark = state_dict["watermark"]

    def train_index(self, number: int) -> Tensor:
        """Return the indices of one training batch, `(B,)`, int64."""
        return self.source.train_index(self.batch_size, self.length, self.seed, number)

    def train_dataloader(self) -> DataLoader[Any]:
        """Return `updates_per_epoch` batches, after those that the trainer has taken."""
        return self._loader("train", _TrainIndices(self))

    def val_dataloader(self) -> DataLoader[Any]:
        """Return the first `validation_sequences` of the validation split, in order."""
        return self._ordered("validation", self.validation_sequences)

    def test_dataloader(self) -> DataLoader[Any]:
        """Return the whole test split, in order."""
        return self._ordered("test", None)

    def predict_dataloader(self) -> DataLoader[Any]:
        """Return the whole test split, in order."""
        return self.test_dataloader()

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> SequenceBatch:
        """Decode on the device."""
        return self._decode(batch)

    def sequences(self, split: Split, index: Tensor, length: int | None = None) -> SequenceBatch:
        """Return chosen sequences of a split on the CPU, cut or padded to `length` (the module's own by default)."""
        return self._decode(self.source.gather(split, index, length or self.length))

    def _decode(self, compact: Any) -> SequenceBatch:
        batch = self.source.decode(compact)
        check_batch(self.source, batch)
        return batch

    def _ordered(self, split: Split, limit: int | None) -> DataLoader[Any]:
        size = self.source.size(split)
        return self._loader(split, torch.arange(min(limit or size, size)).split(4 * self.batch_size))

    def _loader(self, split: Split, indices: Any) -> DataLoader[Any]:
        # A batch is gathered in less time than a worker process needs to hand it over.
        # From pinned memory a GPU fetches it while it still computes.
        batches = _Batches(self.source, split, self.length, indices)
        return DataLoader(batches, batch_size=None, pin_memory=torch.cuda.is_available())
