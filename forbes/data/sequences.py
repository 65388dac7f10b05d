"""Sequences of a source, cut to one length: all of a `SequenceDataModule` that works without a Trainer."""

from typing import Any

from torch import Tensor

from forbes.data.source import SequenceBatch, SequenceSource, Split, check_batch, check_source
from forbes.errors import require_at_least
from forbes.factors import Discrete
from forbes.shapes import Shape

__all__ = ["SequenceData"]


class SequenceData:
    """Sequences of a source, and the order of the training batches.

    It does not import Lightning, which takes longer than loading a run.

    Args:
        source: source of the sequences, e.g. `Strokes`.
        batch_size: number of sequences per batch, B.
        length: number of steps per sequence, T. Sequences are cut or padded to it.
        updates_per_epoch: number of training batches between validations and checkpoints.
        seed: random seed for the order of the training batches.
        validation_sequences: number of validation sequences used after each epoch, the first of the split.

    Raises:
        ForbesError: if a number is below 1, or a batch is larger than the split.
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
    def discrete(self) -> Discrete:
        """Kind of actions, see `Environment.discrete`."""
        return self.source.discrete

    def train_index(self, number: int) -> Tensor:
        """Return the indices of training batch `number`, `(B,)`, int64."""
        return self.source.train_index(self.batch_size, self.length, self.seed, number)

    def sequences(self, split: Split, index: Tensor, length: int | None = None) -> SequenceBatch:
        """Return sequences of a split by index on the CPU, cut or padded to `length` (default: that of the module)."""
        return self.decode(self.source.gather(split, index, length or self.length))

    def decode(self, compact: Any) -> SequenceBatch:
        """Decode a compact batch on its device."""
        batch = self.source.decode(compact)
        check_batch(self.source, batch)
        return batch
