"""One training in several processes (ranks): each has its share of every batch, and all make the same update.

`DistributedDataParallel` averages the gradients of the ranks. That is the gradient of the whole batch only if every
loss is that of the whole batch, also where it divides by the number of steps that count, or takes a maximum with free
nats. So inside `shared_batch`, losses are formed from sums over all ranks.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["WeightedMeans", "gathered", "greatest", "masked_sums", "mean_over_ranks"]
__all__ += ["means_over_ranks", "num_ranks", "of_all_ranks", "rank", "shared_batch", "sum_over_ranks"]

T = TypeVar("T")
_shared = False


def rank() -> int:
    """Return the number of this process in its training, from 0; 0 where there is only one."""
    return dist.get_rank() if _is_running() else 0


def num_ranks() -> int:
    """Return the number of processes of this training."""
    return dist.get_world_size() if _is_running() else 1


def _is_running() -> bool:
    return dist.is_available() and dist.is_initialized()


@contextmanager
def shared_batch() -> Iterator[None]:
    """Let a batch be this rank's share of a larger one: sums and means are over all ranks, which all must form them."""
    global _shared
    before, _shared = _shared, num_ranks() > 1
    try:
        yield
    finally:
        _shared = before


def sum_over_ranks(value: Tensor) -> Tensor:
    r"""Return :math:`\sum_r x_r` inside `shared_batch`, and the value itself elsewhere.

    The gradient with respect to a rank's own value is multiplied by the number of ranks, since
    `DistributedDataParallel` divides by it.
    """
    if not _shared:
        return value
    total: Tensor = _Sum.apply(value)  # type: ignore[no-untyped-call]
    return total


def mean_over_ranks(value: Tensor) -> Tensor:
    """Return the mean of a value over the ranks inside `shared_batch`, and the value itself elsewhere."""
    return sum_over_ranks(value) / num_ranks() if _shared else value


def means_over_ranks(values: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Return the mean of each scalar over the ranks inside `shared_batch`, and the values themselves elsewhere."""
    if not _shared:
        return values
    return dict(zip(values, mean_over_ranks(torch.stack([*values.values()])).unbind(), strict=True))


def masked_sums(values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum of the values that count and their number, over all ranks inside `shared_batch`.

    Args:
        values: numbers, `(*)`.
        mask: True for those that count, `(*)`.
    """
    total, count = (values * mask).sum(), mask.sum()
    if _shared:
        total, count = sum_over_ranks(torch.stack((total, count.to(total)))).unbind()
    return total, count


def greatest(number: int, device: torch.device) -> int:
    """Return the greatest of the numbers with which all ranks call this; `device` is that of the training."""
    if num_ranks() == 1:
        return number
    found = torch.tensor(number, device=device)
    dist.all_reduce(found, dist.ReduceOp.MAX)
    return int(found)


def gathered(value: T) -> list[T]:
    """Return the values with which all ranks call this, in the first rank; an empty list in the others."""
    if num_ranks() == 1:
        return [value]
    found: list[Any] | None = [None] * num_ranks() if rank() == 0 else None
    dist.gather_object(value, found)
    return found or []


def of_all_ranks(value: T) -> list[T]:
    """Return the values with which all ranks call this, in all of them."""
    found: list[Any] = [value]
    if num_ranks() > 1:
        found = [None] * num_ranks()
        dist.all_gather_object(found, value)
    return found


class WeightedMeans:
    """Means of scalars over the batches of all ranks, which may differ in number and size.

    The sums are float64. They stay on the device of the values, so that a batch need not wait for the one before.
    """

    def __init__(self) -> None:
        self._sums: dict[str, tuple[Tensor, float]] = {}

    def add(self, values: Mapping[str, Tensor], weight: float) -> None:
        """Add the values of a batch by name, with the weight of the batch."""
        for name, value in values.items():
            total, weights = self._sums.get(name, (0.0, 0.0))
            self._sums[name] = total + weight * value.detach().double(), weights + weight

    def compute(self) -> dict[str, float]:
        """Return the mean of each value. All ranks must call this, also one that had no batch."""
        totals = torch.stack([total for total, _ in self._sums.values()]).tolist() if self._sums else []
        of_ranks = of_all_ranks({n: (total, self._sums[n][1]) for n, total in zip(self._sums, totals, strict=True)})
        names = dict.fromkeys(name for sums in of_ranks for name in sums)
        found = {name: [sums[name] for sums in of_ranks if name in sums] for name in names}
        return {name: sum(t for t, _ in sums) / sum(w for _, w in sums) for name, sums in found.items()}


class _Sum(torch.autograd.Function):
    """The sum over all ranks, of which each goes on to compute the same."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        total = value.detach().clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return grad * dist.get_world_size()
