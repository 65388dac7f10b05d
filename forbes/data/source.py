"""What a data source gives: sequences of observations, addressed by split and index."""

from abc import ABC, abstractmethod
from functools import lru_cache
from inspect import getattr_static
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forbes.choices import Split
from forbes.errors import ForbesError
from forbes.named import Named
from forbes.seeding import generator
from forbes.shapes import printed_by_shape

__all__ = ["SequenceBatch", "SequenceSource", "Split", "check_batch", "check_source"]


@printed_by_shape
class SequenceBatch(NamedTuple):
    """Sequences, batch first. Index t holds (o_t, a_{t-1}, r_t): the action that led to o_t, zero at the start.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> batch = data.sequences("test", torch.arange(8))
        >>> batch.observation.shape, batch.action.shape
        (torch.Size([8, 30, 1, 28, 28]), torch.Size([8, 30, 0]))
        >>> batch.mask.sum(1)  # steps of each digit
        tensor([29, 30, 19, 30, 30, 17, 30, 29])
    """

    observation: Tensor
    """o_t, uint8 (B, T, C, H, W) for images, float32 (B, T, O) for vectors."""
    action: Tensor
    """a_{t-1}, float32 (B, T, A); A may be 0."""
    reward: Tensor
    """r_t, float32 (B, T)."""
    mask: Tensor
    """True where the step belongs to the sequence, False on padding, bool (B, T)."""
    state: Tensor
    """s_t of the process where the source knows it, float32 (B, T, D), else D = 0; a world model never sees it."""
    ended: Tensor
    """True where the process has ended at that step, by itself and not by a time limit, bool (B, T)."""


class SequenceSource(Named, ABC):
    """A set of sequences. To add one, copy `strokes.py`: four methods and two numbers.

    `gather` runs on the CPU and returns the most compact tensors that determine the batch (a NamedTuple of tensors);
    `decode` turns them into a `SequenceBatch` on whatever device they have been moved to.
    """

    observation_shape: tuple[int, ...]
    """Shape of one observation, without batch and time."""
    action_dim: int
    """A, 0 for a process without actions."""
    discrete: bool = False
    """Whether an action is one of A, as a one-hot vector."""
    increments: bool = False
    """Whether o_t is what step t adds to a picture, pixels of 0 and 1, not the picture itself."""
    watermark: int | None = None
    """Up to where a source that grows was read; a checkpoint keeps it, and a resumed run sets it again."""

    @abstractmethod
    def sha256(self) -> str:
        """Hash what all the sequences are made of, for the record of a run."""

    @abstractmethod
    def size(self, split: Split) -> int:
        """Count the sequences of a split."""

    @abstractmethod
    def gather(self, split: Split, index: Tensor, length: int) -> Any:
        """Collect sequences by index, int64 (B,), cut or padded to `length` steps; compact, on the CPU."""

    @abstractmethod
    def decode(self, compact: Any) -> SequenceBatch:
        """Turn what `gather` returned into a batch, on the device it lies on."""

    def train_index(self, batch_size: int, length: int, seed: int, update: int) -> Tensor:
        """Return the indices of one training batch, int64 `(B,)`: shuffled passes over the split, without replacement.

        Args:
            batch_size: B.
            length: T that `gather` will be asked for.
            seed: of the order.
            update: number of the batch; with the seed it determines it.

        Raises:
            ForbesError: when a batch is larger than the split.
        """
        size = self.size("train")
        if batch_size > size:
            raise ForbesError(
                f"SequenceDataModule: batch_size is {batch_size}, but the training split has {size} sequences. "
                "Choose a smaller batch_size"
            )
        turn, place = divmod(update, size // batch_size)
        return _order(seed, turn, size)[place * batch_size : (place + 1) * batch_size]  # (B,)

    def pictures(self, observation: Tensor) -> Tensor:
        r"""Return what a person is shown of observations from the first step on, `(B, T, *O)`.

        Increments add up: a pixel is on that any step so far has put on. Of probabilities it is how likely that is,

        .. math:: \text{picture}_t = 1 - \prod_{u \le t} (1 - x_u)
        """
        if not self.increments:
            return observation
        return 1 - (1 - observation).cumprod(1, dtype=observation.dtype)

    def latest(self, count: int) -> Tensor:
        """Return training sequences to look at, those first that were learned from least; int64 `(count,)` or fewer."""
        return torch.arange(min(count, self.size("train")))


def check_source(source: SequenceSource) -> None:
    """Raise a ForbesError unless a source says its shapes; properties are left for later, since they may cost."""
    kind = type(source).__name__
    for name, expected in (("observation_shape", "(C, H, W) or (O,)"), ("action_dim", "a whole number, at least 0")):
        if getattr_static(source, name, None) is None:
            raise ForbesError(f"{kind}: it has no {name}, expected {expected}. Set it in its constructor")


def check_batch(source: SequenceSource, batch: SequenceBatch) -> None:
    """Raise a ForbesError unless a batch is what `SequenceBatch` says, of the shapes that its source says."""
    kind, shape = type(source).__name__, tuple(source.observation_shape)
    if not isinstance(batch, SequenceBatch):
        raise ForbesError(f"{kind}: decode gives a {type(batch).__name__}, expected a SequenceBatch. Return one")
    steps = tuple(batch.mask.shape)  # (B, T)
    expected: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
        "observation": (torch.uint8 if len(shape) == 3 else torch.float32, (*steps, *shape)),
        "action": (torch.float32, (*steps, source.action_dim)),
        "reward": (torch.float32, steps),
        "mask": (torch.bool, steps[:2]),
        "state": (torch.float32, (*steps, batch.state.shape[-1])),
        "ended": (torch.bool, steps),
    }
    for name, (dtype, size) in expected.items():
        values: Tensor = getattr(batch, name)
        if values.dtype != dtype or tuple(values.shape) != size:
            raise ForbesError(
                f"{kind}: decode gives {name} {_said(values.dtype)} {tuple(values.shape)}, expected {_said(dtype)} "
                f"{size}. Change decode, or observation_shape and action_dim"
            )


def _said(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


@lru_cache(maxsize=2)
def _order(seed: int, turn: int, size: int) -> Tensor:
    """Shuffle a split for one pass over it."""
    return torch.randperm(size, generator=generator(seed, "order", turn))
