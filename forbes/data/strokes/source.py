"""Sequential MNIST: digits as a pen writes them. Frame t shows the first t points of the path."""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from forbes.bundled import bundled
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.data.strokes.dejong import dejong_path, verify_dejong
from forbes.data.strokes.file import SIDE, StrokeArrays, load_strokes, sha256_of_arrays
from forbes.errors import ForbesError, require_at_least, require_one_of
from forbes.rounding import ceil_div
from forbes.shapes import printed_by_shape

__all__ = ["StrokePoints", "Strokes", "bundled_path"]


@printed_by_shape
class StrokePoints(NamedTuple):
    """The pen paths of some digits, the compact form of their frames."""

    points: Tensor
    """Pixels (x, y) in writing order, the last one repeated as padding, uint8 (B, T * points_per_step, 2)."""
    number: Tensor
    """Number of points without padding, int64 (B,)."""


def bundled_path() -> Path:
    """Return the path of the bundled set."""
    return bundled("strokes.npz")


class Strokes(SequenceSource):
    r"""MNIST digits as they are written, rendered on the fly from the pen's path.

    With k points per step, step t adds the points :math:`k(t-1)+1, …, \min(kt, n)` of the digit's n points. A `whole`
    frame shows all pixels visited so far, a `written` frame those first visited at step t. Both are binary and related
    by a bijection, so the log-probability of a sequence is the same for both:

    .. math:: w_t = x_t - x_{t-1}, \qquad x_t = \sum_{u \le t} w_u, \qquad x_0 = 0

    There are no actions and no rewards::

        k = 2, n = 5     t        1     2     3     4
                         whole    1-2   1-4   1-5   1-5
                         written  1-2   3-4   5     none
                         mask     true  true  true  false

    Args:
        origin: `bundled`, our own extraction from the MNIST images, which comes with the package; or `dejong`, the
            paper's set, stored by `forbes data fetch strokes`.
        path: stroke file to read instead of the origin's.
        points_per_step: number of points that each frame adds, 1 in the paper. With 2, 30 frames show 99 % of the
            digits to the end.
        validation: number of training digits, at the end of the split, that form the validation split.
        frames: `written` frames have the pixels added at each step: with one point per step one pixel, or none where
            the pen crosses its path. `whole` frames, as in the paper, show the first t points; most of their likelihood
            is that of redrawing past frames.
        end: with `masked`, steps after a digit's end do not count, and nothing tells a model when a digit is finished:
            it draws on. With `observed` they count, as steps at which nothing is written, and a model learns where
            digits end.

    Example:
        >>> source = forbes.Strokes(frames="whole")
        >>> source.size("test"), source.observation_shape
        (10000, (1, 28, 28))
        >>> source.steps("test")[:3]  # length of each digit
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
        end: Literal["masked", "observed"] = "masked",
    ) -> None:
        require_at_least(1, "Strokes", points_per_step=points_per_step)
        require_at_least(0, "Strokes", validation=validation)
        require_one_of(("bundled", "dejong"), "Strokes", origin=origin)
        require_one_of(("written", "whole"), "Strokes", frames=frames)
        require_one_of(("masked", "observed"), "Strokes", end=end)
        self.origin = origin
        self.path = path
        self.points_per_step = points_per_step
        self.validation = validation
        self.frames = frames
        self.increments = frames == "written"
        self.end = end

    @cached_property
    def _splits(self) -> dict[Split, StrokeArrays]:
        """Arrays of the file by split, read on first use."""
        if self.origin == "bundled":
            path, remedy = bundled_path(), "Rebuild it with: forbes data build-strokes --images DIR"
        else:
            path = dejong_path()
            remedy = "Get it with: forbes data fetch strokes --from PATH, or use the bundled origin"
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
        """Return the number of digits of a split."""
        return len(self._splits[split].labels)

    def arrays(self, split: Split) -> StrokeArrays:
        """Return the pen paths of a split, including pen lifts."""
        return self._splits[split]

    def labels(self, split: Split) -> Tensor:
        """Return the class of each digit of a split, int64 (N,)."""
        return torch.from_numpy(self._splits[split].labels).long()

    def steps(self, split: Split) -> Tensor:
        """Return the number of steps of each digit of a split, int64 (N,)."""
        points = self._tensors[split][1].diff()  # (N,)
        return ceil_div(points, self.points_per_step)

    def gather(self, split: Split, index: Tensor, length: int) -> StrokePoints:
        """Return the paths of digits by index, int64 (B,), cut or padded to `length` steps."""
        require_at_least(1, "Strokes", length=length)
        points, offsets = self._tensors[split]
        first = offsets[index]  # (B,)
        number = (offsets[index + 1] - first).clamp(max=length * self.points_per_step)  # (B,)
        step = torch.arange(length * self.points_per_step)  # (P,)
        step = torch.minimum(step, number[:, None] - 1)  # (B, P), stays at the last point
        return StrokePoints(points[first[:, None] + step], number)  # (B, P, 2), (B,)

    def decode(self, compact: StrokePoints) -> SequenceBatch:
        """Render frames from points, on their device.

        A pixel is on from its first visit, so all frames result from one comparison of first visits with t.
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
        mask = time * self.points_per_step < number[:, None]  # (B, T)
        return SequenceBatch(
            observation=frames.to(torch.uint8).view(batch, length, 1, SIDE, SIDE),  # (B, T, 1, H, W)
            action=torch.zeros(batch, length, 0, device=device),
            reward=torch.zeros(batch, length, device=device),
            mask=mask if self.end == "masked" else torch.ones_like(mask),
            state=torch.zeros(batch, length, 0, device=device),
            ended=torch.zeros(batch, length, dtype=torch.bool, device=device),
        )


def _divide(arrays: StrokeArrays, digits: int) -> tuple[StrokeArrays, StrokeArrays]:
    """Split off the first `digits` digits."""
    points, pen_up, offsets, labels = arrays
    cut = offsets[digits]
    return (
        StrokeArrays(points[:cut], pen_up[:cut], offsets[: digits + 1], labels[:digits]),
        StrokeArrays(points[cut:], pen_up[cut:], offsets[digits:] - cut, labels[digits:]),
    )
