"""The interface of data sources: sequences of observations, addressed by split and index."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import lru_cache
from inspect import getattr_static
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forbes.choices import Split
from forbes.errors import ForbesError
from forbes.factors import Discrete
from forbes.named import Named
from forbes.seeding import generator
from forbes.shapes import Observed, Shape, map_parts, printed_by_shape

__all__ = ["SequenceBatch", "SequenceSource", "Split", "check_batch", "check_source"]


@printed_by_shape
class SequenceBatch(NamedTuple):
    """Sequences, batch first. Index t has (o_t, a_{t-1}, r_t): the action is the one that led to o_t, 0 at the start.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> batch = data.sequences("test", torch.arange(8))
        >>> batch.observation.shape, batch.action.shape
        (torch.Size([8, 30, 1, 28, 28]), torch.Size([8, 30, 0]))
        >>> batch.mask.sum(1)  # steps of each digit
        tensor([29, 30, 19, 30, 30, 17, 30, 29])
    """

    observation: Observed
    """o_t, uint8 (B, T, C, H, W) for images, float32 (B, T, O) for vectors; of several parts a dict of them by name."""
    action: Tensor
    """a_{t-1}, float32 (B, T, A); A may be 0."""
    reward: Tensor
    """r_t, float32 (B, T)."""
    mask: Tensor
    """True where the step belongs to the sequence, False on padding, bool (B, T)."""
    state: Tensor
    """s_t of the process, float32 (B, T, D), with D = 0 if it is unknown. World models do not use it."""
    ended: Tensor
    """True at the step where the process terminated (not truncated by a time limit), bool (B, T)."""

    @property
    def observed(self) -> Observed:
        """The observations without padding, `(N, *O)`."""
        return map_parts(lambda values: values[self.mask], self.observation)

    def to(self, device: torch.device | str) -> "SequenceBatch":
        """Move the batch to a device."""
        return self.each(lambda values: values.to(device))

    def first(self, steps: int) -> "SequenceBatch":
        """Return the first steps of all sequences, `(B, steps, ...)`."""
        return self.each(lambda values: values[:, :steps])

    def after(self, steps: int) -> "SequenceBatch":
        """Return the steps after the first ones of all sequences, `(B, T - steps, ...)`."""
        return self.each(lambda values: values[:, steps:])

    def rows(self, rows: slice) -> "SequenceBatch":
        """Return some of the sequences."""
        return self.each(lambda values: values[rows])

    def each(self, function: Callable[[Tensor], Tensor]) -> "SequenceBatch":
        """Return the batch with a function applied to every tensor, also to those of the observation's parts."""
        return SequenceBatch(*(map_parts(function, values) for values in self))


class SequenceSource(Named, ABC):
    """A set of sequences. To add one, copy `strokes/source.py`: four methods and two attributes.

    `gather` runs on the CPU and returns compact tensors that determine the batch (a NamedTuple of tensors). `decode`
    turns them into a `SequenceBatch` on the device to which they were moved.
    """

    observation_shape: Shape
    """Shape of one observation, without batch and time, or of its parts by name."""
    action_dim: int
    """Dimension of an action, A; 0 for a process without actions."""
    discrete: Discrete = False
    """Kind of actions, see `Environment.discrete`."""
    increments: bool = False
    """Whether o_t has the pixels (0 or 1) that step t adds to an image, instead of the image itself."""
    watermark: int | None = None
    """Number of episodes of a growing source. A checkpoint stores it, and a resumed run restores it."""

    @abstractmethod
    def sha256(self) -> str:
        """Return a hash of all sequences, for the record of a run."""

    @abstractmethod
    def size(self, split: Split) -> int:
        """Return the number of sequences of a split."""

    def episodes(self, split: Split, index: Tensor) -> list[int] | None:
        """Return the number of the episode of each sequence, if several are parts of one: they are not independent.

        Args:
            split: train, validation or test.
            index: numbers of sequences, int64 (B,).
        """
        return None

    @abstractmethod
    def gather(self, split: Split, index: Tensor, length: int) -> Any:
        """Return sequences by index, int64 (B,), cut or padded to `length` steps, in compact form on the CPU."""

    @abstractmethod
    def decode(self, compact: Any) -> SequenceBatch:
        """Return the batch for the output of `gather`, on its device."""

    def train_index(self, batch_size: int, length: int, seed: int, update: int) -> Tensor:
        """Return the indices of one training batch, int64 `(B,)`: shuffled passes over the split, without replacement.

        Args:
            batch_size: number of sequences per batch, B.
            length: number of steps per sequence, T.
            seed: random seed for the order.
            update: index of the batch.

        Raises:
            ForbesError: if a batch is larger than the split.
        """
        size = self.size("train")
        if batch_size > size:
            raise ForbesError(
                f"SequenceDataModule: batch_size is {batch_size}, but the training split has {size} sequences. "
                "Choose a smaller batch_size"
            )
        epoch, batch = divmod(update, size // batch_size)
        return _order(seed, epoch, size)[batch * batch_size : (batch + 1) * batch_size]  # (B,)

    def pictures(self, observation: Tensor) -> Tensor:
        r"""Return the images to show for observations from the first step on, `(B, T, *O)`.

        Increments are accumulated: a pixel is on if any step so far has set it. For pixel probabilities, the result is
        the probability that it is on,

        .. math:: \text{picture}_t = 1 - \prod_{u \le t} (1 - x_u)
        """
        if not self.increments:
            return observation
        return 1 - (1 - observation).cumprod(1, dtype=observation.dtype)

    def latest(self, count: int) -> Tensor:
        """Return indices of training sequences to show, newest first if the source grows; int64 `(count,)` or fewer."""
        return torch.arange(min(count, self.size("train")))


def check_source(source: SequenceSource) -> None:
    """Raise a ForbesError unless a source defines its shapes. Properties are not evaluated, since that may be slow."""
    kind = type(source).__name__
    for name, expected in (("observation_shape", "(C, H, W) or (O,)"), ("action_dim", "a whole number, at least 0")):
        if getattr_static(source, name, None) is None:
            raise ForbesError(f"{kind}: it has no {name}, expected {expected}. Set it in its constructor")


def check_batch(source: SequenceSource, batch: SequenceBatch) -> None:
    """Raise a ForbesError unless a batch is a `SequenceBatch` with the shapes and dtypes of its source."""
    kind = type(source).__name__
    if not isinstance(batch, SequenceBatch):
        raise ForbesError(f"{kind}: decode returns a {type(batch).__name__}, expected a SequenceBatch. Change decode")
    steps = tuple(batch.mask.shape)  # (B, T)
    shapes, values = _by_name(source.observation_shape), _by_name(batch.observation)
    if {*shapes} != {*values}:
        raise ForbesError(
            f"{kind}: decode returns {', '.join(values)}, expected {', '.join(shapes)}. Change decode or "
            "observation_shape"
        )
    expected: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
        name: (torch.uint8 if len(shape) == 3 else torch.float32, (*steps, *shape)) for name, shape in shapes.items()
    }
    expected |= {
        "action": (torch.float32, (*steps, source.action_dim)),
        "reward": (torch.float32, steps),
        "mask": (torch.bool, steps[:2]),
        "state": (torch.float32, (*steps, batch.state.shape[-1])),
        "ended": (torch.bool, steps),
    }
    values |= {name: getattr(batch, name) for name in batch._fields[1:]}
    for name, (dtype, size) in expected.items():
        found: Tensor = values[name]
        if found.dtype != dtype or tuple(found.shape) != size:
            raise ForbesError(
                f"{kind}: decode returns {name} {_name(found.dtype)} {tuple(found.shape)}, expected {_name(dtype)} "
                f"{size}. Change decode, or observation_shape and action_dim"
            )


def _by_name(observed: Any) -> dict[str, Any]:
    """Return an observation or its parts, or the shapes of them, by name."""
    if isinstance(observed, Mapping):
        return {f"observation {name}": part for name, part in observed.items()}
    return {"observation": observed}


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


@lru_cache(maxsize=2)
def _order(seed: int, epoch: int, size: int) -> Tensor:
    """Return the shuffled indices of a split for one pass over it."""
    return torch.randperm(size, generator=generator(seed, "order", epoch))
