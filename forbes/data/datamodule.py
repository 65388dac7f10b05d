"""The DataModule: batches of sequences from any source. A batch is a pure function of (seed, update)."""

from collections.abc import Iterator
from typing import Any

import torch
from lightning import LightningDataModule, Trainer
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from forbes.data.source import SequenceBatch, SequenceSource, Split, check_batch, check_source
from forbes.distributed import num_ranks, rank
from forbes.errors import ForbesError, require_at_least
from forbes.shapes import Shape

__all__ = ["SequenceDataModule", "datamodule_of", "require_divisible"]


class _Batches(IterableDataset[Any]):
    """Compact batches of a split, from a list of indices per batch."""

    def __init__(self, source: SequenceSource, split: Split, length: int, indices: Any) -> None:
        self.source, self.split, self.length, self.indices = source, split, length, indices

    def __iter__(self) -> Iterator[Any]:
        for index in self.indices:  # lazily: the trainer may not know its update yet when the iterator is created
            yield self.source.gather(self.split, index, self.length)

    def __len__(self) -> int:
        return len(self.indices)


class _TrainIndices:
    """Indices of the batches of an epoch, chosen by the source, starting after the batches already trained on."""

    def __init__(self, datamodule: "SequenceDataModule") -> None:
        self.datamodule = datamodule

    def __iter__(self) -> Iterator[Tensor]:
        trainer = self.datamodule.trainer
        first = _batches_taken(trainer) if trainer is not None else 0
        return (_share(self.datamodule.train_index(number)) for number in range(first, first + len(self)))

    def __len__(self) -> int:
        return self.datamodule.updates_per_epoch


def require_divisible(batch_size: int, processes: int) -> None:
    """Raise a ForbesError if the processes of a training cannot share a batch equally."""
    if batch_size % processes:
        raise ForbesError(
            f"SequenceDataModule: batch_size is {batch_size}, expected a multiple of {processes}, the number of "
            "processes that share each batch. Choose another"
        )


def _share(index: Tensor) -> Tensor:
    """Return the part of a training batch, `(B,)`, that belongs to this rank, `(B / R,)`.

    Raises:
        ForbesError: if the ranks do not divide the batch.
    """
    require_divisible(len(index), num_ranks())
    return index.reshape(num_ranks(), -1)[rank()]  # (B / R,)


def _batches_taken(trainer: Trainer) -> int:
    """Return the number of training batches so far; with `overfit_batches`, those of this epoch only."""
    loop, same = trainer.fit_loop, trainer.overfit_batches  # type: ignore[attr-defined]  # set by a helper of Lightning
    return 1 + (loop.batch_idx if same else loop.total_batch_idx)


def datamodule_of(trainer: Trainer) -> "SequenceDataModule":
    """Return the data module of a trainer, an attribute that Lightning does not declare."""
    data: SequenceDataModule = trainer.datamodule  # type: ignore[attr-defined]
    return data


class SequenceDataModule(LightningDataModule):
    """Batches of `SequenceBatch` from a source; images stay uint8 until they are on the device.

    Training batch i is a pure function of (seed, i). A resumed run continues with the batch it would have had, and no
    loader or RNG state is stored. An epoch is a number of updates, not a pass over the data. The R processes of one
    training share every batch: rank r has the rows from r B / R on. They share the batches of the other splits out.

    Args:
        source: source of the sequences, e.g. `Strokes`.
        batch_size: number of sequences per batch, B.
        length: number of steps per sequence, T. Sequences are cut or padded to it.
        updates_per_epoch: number of training batches between validations and checkpoints.
        seed: random seed for the order of the training batches.
        validation_sequences: number of validation sequences used after each epoch, the first of the split.

    Raises:
        ForbesError: if a number is below 1, or a batch is larger than the split.

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
    def observation_shape(self) -> Shape:
        """Shape of one observation, or of its parts by name."""
        return self.source.observation_shape

    @property
    def action_dim(self) -> int:
        """Dimension of an action, A."""
        return self.source.action_dim

    @property
    def discrete(self) -> bool:
        """Whether an action is a one-hot vector."""
        return self.source.discrete

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint: the number of episodes of a growing source."""
        return {} if self.source.watermark is None else {"watermark": self.source.watermark}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the source to the episodes it had at the checkpoint."""
        self.source.watermark = state_dict["watermark"]

    def train_index(self, number: int) -> Tensor:
        """Return the indices of training batch `number`, `(B,)`, int64."""
        return self.source.train_index(self.batch_size, self.length, self.seed, number)

    def train_dataloader(self) -> DataLoader[Any]:
        """Return `updates_per_epoch` batches, starting after the batches already trained on."""
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
        """Decode a batch on the device."""
        return self._decode(batch)

    def sequences(self, split: Split, index: Tensor, length: int | None = None) -> SequenceBatch:
        """Return sequences of a split by index on the CPU, cut or padded to `length` (default: that of the module)."""
        return self._decode(self.source.gather(split, index, length or self.length))

    def _decode(self, compact: Any) -> SequenceBatch:
        batch = self.source.decode(compact)
        check_batch(self.source, batch)
        return batch

    def _ordered(self, split: Split, limit: int | None) -> DataLoader[Any]:
        size = self.source.size(split)
        batches = torch.arange(min(limit or size, size)).split(4 * self.batch_size)
        # Lightning leaves the loop out on a rank that has no batch, and the others would wait for it.
        return self._loader(split, batches[rank() :: num_ranks()] or [torch.arange(0)])

    def _loader(self, split: Split, indices: Any) -> DataLoader[Any]:
        # No workers: gathering a batch takes less time than its transfer from a worker process.
        # Pinned memory: the copy to a GPU overlaps with its computation.
        batches = _Batches(self.source, split, self.length, indices)
        return DataLoader(batches, batch_size=None, pin_memory=torch.cuda.is_available())
