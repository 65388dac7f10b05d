"""Sequences sampled once from a known process, so that exact beliefs and likelihoods are available."""

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
    """Observations, actions and states of some sequences."""

    observation: Tensor
    """o_t, float32 (B, T, O)."""
    action: Tensor
    """a_{t-1}, float32 (B, T, A)."""
    state: Tensor
    """s_t, float32 (B, T, D)."""


class Simulated(SequenceSource):
    """Sequences of a process under its random policy, sampled once per split.

    Args:
        process: process to sample from, e.g. `MirrorSensor`.
        train: number of training sequences.
        validation: number of validation sequences.
        test: number of test sequences.
        seed: random seed for the sequences, independent of the training seed, so that all models see the same data.

    Raises:
        ForbesError: if a split would be empty.

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
        """Return all sequences of a split with their hidden states, float64. Other lengths are other sequences."""
        if (split, length) not in self._drawn:
            self._drawn[split, length] = self._draw(split, self.size(split), length)
        return self._drawn[split, length]

    def _draw(self, split: Split, sequences: int, length: int) -> Trajectories:
        return self.process.sample(sequences, length, generator(self.seed, f"simulated {split}", length))

    def sha256(self) -> str:
        """Hash ten sequences of each split, which depend on the process, its parameters, the seed and the code."""
        digest = hashlib.sha256()
        for split in get_args(Split):
            digest.update(f"{split} {self.size(split)}".encode())
            for values in self._draw(split, sequences=10, length=10):
                digest.update(values.numpy().tobytes())
        return digest.hexdigest()

    def size(self, split: Split) -> int:
        """Return the number of sequences of a split."""
        return {"train": self.train, "validation": self.validation, "test": self.test}[split]

    def gather(self, split: Split, index: Tensor, length: int) -> SimulatedSequences:
        """Return sequences by index, int64 (B,), with `length` steps each."""
        drawn = self.trajectories(split, length)
        return SimulatedSequences(*(values[index].float() for values in (drawn.observation, drawn.action, drawn.state)))

    def decode(self, compact: SimulatedSequences) -> SequenceBatch:
        """Add rewards and ends, which are all 0, and the mask, which is all True."""
        observation, action, state = compact
        shape, device = observation.shape[:2], observation.device
        mask = torch.ones(shape, dtype=torch.bool, device=device)
        return SequenceBatch(observation, action, torch.zeros(shape, device=device), mask, state, ended=~mask)
