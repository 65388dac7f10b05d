"""Sequences of a known process, drawn once: data whose belief and whose likelihood are known exactly."""

import hashlib
from typing import NamedTuple, get_args

import torch
from torch import Tensor

from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.errors import require_at_least
from forbes.pomdps import Process, Trajectories
from forbes.pomdps.hmm import FiniteProcess
from forbes.seeding import generator
from forbes.shapes import printed_by_shape

__all__ = ["Simulated", "SimulatedSequences"]


@printed_by_shape
class SimulatedSequences(NamedTuple):
    """Some sequences in full."""

    observation: Tensor
    """o_t, float32 (B, T, O)."""
    action: Tensor
    """a_{t-1}, float32 (B, T, A)."""
    state: Tensor
    """s_t, float32 (B, T, D)."""


class Simulated(SequenceSource):
    """Sequences of a process under its random policy, drawn once per split.

    Args:
        process: e.g. `MirrorSensor`.
        train: sequences of the training split.
        validation: of the validation split.
        test: of the test split.
        seed: of the sequences; the same for every training, so that models are compared on the same data.

    Raises:
        ForbesError: when a split would be empty.

    Example:
        >>> source = forbes.Simulated(forbes.MirrorSensor(), train=100)
        >>> data = forbes.SequenceDataModule(source, length=20)
        >>> batch = data.sequences("train", torch.arange(5))
        >>> batch.observation.shape, batch.state.shape
        (torch.Size([5, 20, 1]), torch.Size([5, 20, 1]))
    """

    def __init__(
        self, process: Process, train: int = 10_000, validation: int = 1000, test: int = 1000, seed: int = 0
    ) -> None:
        require_at_least(1, "Simulated", train=train, validation=validation, test=test)
        self.process, self.train, self.validation, self.test, self.seed = process, train, validation, test, seed
        self.observation_shape = (process.observation_dim,)
        self.action_dim, self.discrete = process.action_dim, isinstance(process, FiniteProcess)
        self._drawn: dict[tuple[Split, int], Trajectories] = {}

    def trajectories(self, split: Split, length: int) -> Trajectories:
        """Return all sequences of a split with their hidden states, float64; they depend on the length, too."""
        if (split, length) not in self._drawn:
            self._drawn[split, length] = self._draw(split, self.size(split), length)
        return self._drawn[split, length]

    def _draw(self, split: Split, sequences: int, length: int) -> Trajectories:
        return self.process.sample(sequences, length, generator(self.seed, f"simulated {split}", length))

    def sha256(self) -> str:
        """Hash some sequences of each split: they tell the process, its numbers, the seed and the library's version."""
        digest = hashlib.sha256()
        for split in get_args(Split):
            digest.update(f"{split} {self.size(split)}".encode())
            for values in self._draw(split, sequences=10, length=10):
                digest.update(values.numpy().tobytes())
        return digest.hexdigest()

    def size(self, split: Split) -> int:
        """Count the sequences of a split."""
        return {"train": self.train, "validation": self.validation, "test": self.test}[split]

    def gather(self, split: Split, index: Tensor, length: int) -> SimulatedSequences:
        """Collect sequences by index, int64 (B,), of `length` steps each."""
        drawn = self.trajectories(split, length)
        return SimulatedSequences(*(values[index].float() for values in (drawn.observation, drawn.action, drawn.state)))

    def decode(self, compact: SimulatedSequences) -> SequenceBatch:
        """Add what these sequences have not: rewards, padding and ends."""
        observation, action, state = compact
        shape, device = observation.shape[:2], observation.device
        mask = torch.ones(shape, dtype=torch.bool, device=device)
        return SequenceBatch(observation, action, torch.zeros(shape, device=device), mask, state, ended=~mask)
