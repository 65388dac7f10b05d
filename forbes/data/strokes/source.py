"""Sequential MNIST: a digit appears as a pen writes it, frame t showing the first t points of its path."""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from forbes.data.download import bundled
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.data.strokes.dejong import dejong_path, verify_dejong
from forbes.data.strokes.file import SIDE, StrokeArrays, load_strokes, sha256_of_arrays
from forbes.errors import ForbesError, require_at_least
from forbes.shapes import printed_by_shape

__all__ = ["StrokePoints", "Strokes", "bundled_path"]


@printed_by_shape
class StrokePoints(NamedTuple):
    """The pen paths of some digits, the compact form of their frames."""

    points: Tensor
    """Pixels (x, y) in writing order, the last one repeated as padding, uint8 (B, T * points_per_step, 2)."""
    number: Tensor
    """Points that are no padding, int64 (B,)."""


def bundled_path() -> Path:
    """Return the path of the set that comes with the package."""
    return bundled("strokes.npz")


class Strokes(SequenceSource):
    r"""MNIST digits as they are written, rendered on the fly from the pen's path.

    With k points a step, step t adds the points :math:`k(t-1)+1, …, \min(kt, n)` of the digit's n points. A whole
    frame shows all pixels visited so far, a written frame those that step t has visited first. Both are binary, and
    one is a bijection of the other, so the log-probability of a sequence is the same for both:

    .. math:: w_t = x_t - x_{t-1}, \qquad x_t = \sum_{u \le t} w_u, \qquad x_0 = 0

    There are no actions and no rewards::

        k = 2, n = 5     t        1     2     3     4
                         whole    1-2   1-4   1-5   1-5
                         written  1-2   3-4   5     none
                         mask     true  true  true  false

    Args:
        origin: ``bundled``, our own extraction from the MNIST images, comes with the package; ``dejong`` is the
            paper's set, stored by ``forbes data fetch strokes``.
        path: Read this file instead of the origin's own.
        points_per_step: Points that each frame adds. 1 is the paper's; 2 shows 99 % of the digits whole in 30 frames.
        validation: The last so many training digits are the validation split.
        frames: ``written``, what each step adds: at one point a step one pixel, or none where the pen crosses its own
            path. ``whole``, the paper's, show the first t points; their likelihood is mostly that of the past, drawn
            again.

    Example:
        >>> source = forbes.Strokes(frames="whole")
        >>> source.size("test"), source.observation_shape
        (10000, (1, 28, 28))
        >>> source.steps("test")[:3]  # until each digit is whole
        tensor([29, 37, 19])
    """

    observation_shape = (1, SIDE, SIDE)
    action_dim = 0

    def __init__(
        self,
        origin: Literal["bundled", "dejong"] = "bundled",
        path: str | None = None,
        points_per_step: int = 1,
        validation: int = 5000,
        frames: Literal["written", "whole"] = "written",
    ) -> None:
        require_at_least(1, "Strokes", points_per_step=points_per_step)
        require_at_least(0, "Strokes", validation=validation)
        self.origin = origin
        self.path = path
        self.points_per_step = points_per_step
        self.validation = validation
        self.frames = frames
        self.increments = frames == "written"

    @cached_property
    def _splits(self) -> dict[Split, StrokeArrays]:
        """The file's arrays by split, read on first use."""
        if self.origin == "bundled":
            path, remedy = bundled_path(), "Rebuild it with: forbes data build-strokes --images DIR"
        else:
            path = dejong_path()
            remedy = "Get it with: forbes data fetch strokes --from PATH, or use the origin bundled"
        path = Path(self.path) if self.path else path
        file = load_strokes(path, remedy)
        if self.origin == "dejong":
            verify_dejong(file, path, remedy)
        digits = len(file["train"].labels)
        if self.validation >= digits:
            raise ForbesError(f"Strokes: validation is {self.validation}, expected less than the {digits} digits.")
        train, validation = _divide(file["train"], digits - self.validation)
        return {"train": train, "validation": validation, "test": file["test"]}

    @cached_property
    def _tensors(self) -> dict[Split, tuple[Tensor, Tensor]]:
        """Points (P, 2) and offsets (N + 1,) by split."""
        return {
            split: (torch.from_numpy(arrays.points), torch.from_numpy(arrays.offsets).long())
            for split, arrays in self._splits.items()
        }

    def sha256(self) -> str:
        """Hash the arrays of all splits."""
        hashes = sha256_of_arrays({name: arrays for name, arrays in self._splits.items()})
        return hashlib.sha256(" ".join(hashes.values()).encode()).hexdigest()

    def size(self, split: Split) -> int:
        """Count the digits of a split."""
        return len(self._splits[split].labels)

    def arrays(self, split: Split) -> StrokeArrays:
        """Return a split's pen paths, pen lifts included."""
        return self._splits[split]

    def labels(self, split: Split) -> Tensor:
        """Return the class of each digit of a split, int64 (N,)."""
        return torch.from_numpy(self._splits[split].labels).long()

    def steps(self, split: Split) -> Tensor:
        """Count the steps of each digit of a split until it is whole, int64 (N,)."""
        points = self._tensors[split][1].diff()  # (N,)
        return -(-points // self.points_per_step)

    def gather(self, split: Split, index: Tensor, length: int) -> StrokePoints:
        """Collect the paths of digits `index`, int64 (B,), cut or padded to `length` steps."""
        require_at_least(1, "Strokes", length=length)
        points, offsets = self._tensors[split]
        first = offsets[index]  # (B,)
        number = (offsets[index + 1] - first).clamp(max=length * self.points_per_step)  # (B,)
        step = torch.arange(length * self.points_per_step)  # (P,)
        step = torch.minimum(step, number[:, None] - 1)  # (B, P), stays at the last point
        return StrokePoints(points[first[:, None] + step], number)  # (B, P, 2), (B,)

    def decode(self, compact: StrokePoints) -> SequenceBatch:
        """Render frames from points, on the device the points lie on.

        A pixel is written at its first visit and on from there, so one comparison of first visits with t gives all.
        """
        points, number = compact
        batch, device = len(points), points.device
        length = points.shape[1] // self.points_per_step
        time = torch.arange(length, device=device)  # (T,)
        step = time.repeat_interleave(self.points_per_step).expand(batch, -1)  # (B, P)
        pixel = points[..., 1].long() * SIDE + points[..., 0]  # (B, P)
        never = torch.full((batch, SIDE * SIDE), length, device=device)
        first_visit = never.scatter_reduce(1, pixel, step, "amin")  # (B, H * W)
        first_visit, step = first_visit[:, None], time[:, None]  # (B, 1, H * W), (T, 1)
        frames = first_visit == step if self.increments else first_visit <= step  # (B, T, H * W)
        return SequenceBatch(
            observation=frames.to(torch.uint8).view(batch, length, 1, SIDE, SIDE),  # (B, T, 1, H, W)
            action=torch.zeros(batch, length, 0, device=device),
            reward=torch.zeros(batch, length, device=device),
            mask=time * self.points_per_step < number[:, None],  # (B, T)
            state=torch.zeros(batch, length, 0, device=device),
            ended=torch.zeros(batch, length, dtype=torch.bool, device=device),
        )


def _divide(arrays: StrokeArrays, digits: int) -> tuple[StrokeArrays, StrokeArrays]:
    """Part the first so many digits from the others."""
    points, pen_up, offsets, labels = arrays
    cut = offsets[digits]
    return (
        StrokeArrays(points[:cut], pen_up[:cut], offsets[: digits + 1], labels[:digits]),
        StrokeArrays(points[cut:], pen_up[cut:], offsets[digits:] - cut, labels[digits:]),
    )
