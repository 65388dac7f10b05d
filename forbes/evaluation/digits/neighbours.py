"""Training digits with similar beginnings: possible completions of a digit, without a model."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from forbes.data import SequenceData, Strokes

__all__ = ["TrainingPrefixes", "last_frame", "mean_frame"]


def last_frame(frames: Tensor) -> Tensor:
    """Return the last frame, which shows where the pen has been, `(B, T, C, H, W)` to `(B, C, H, W)`."""
    return frames[:, -1].float()


def mean_frame(frames: Tensor) -> Tensor:
    """Return the mean frame, `(B, T, C, H, W)` to `(B, C, H, W)`. As frames are cumulative, it shows the order too."""
    return frames.sum(1).float() / frames.shape[1]


class TrainingPrefixes:
    """Beginnings of the training digits that continue after some step.

    They are compared after a blur of five pixels, so that strokes one pixel apart are near.

    Args:
        data: data module of digit strokes.
        time: number of steps of the beginning.
        look: function that reduces the frames to one image, `last_frame` or `mean_frame`.
    """

    def __init__(self, data: SequenceData, time: int, look: Callable[[Tensor], Tensor]) -> None:
        assert isinstance(data.source, Strokes)
        self.look = look
        self.index = torch.nonzero(data.source.steps("train") > time)[:, 0]  # (M,)
        parts = (data.sequences("train", index, time).observation for index in self.index.split(5000))
        self.pictures = torch.cat([self._picture(data.source.pictures(frames)) for frames in parts])  # (M, H W)

    def nearest(self, frames: Tensor, count: int) -> Tensor:
        """Return the indices, `(B, count)`, of the training digits most like the frames, `(B, T, C, H, W)`."""
        distance = torch.cdist(self._picture(frames), self.pictures)  # (B, M)
        return self.index[distance.topk(min(count, len(self.index)), largest=False).indices]

    def _picture(self, frames: Tensor) -> Tensor:
        return avg_pool2d(self.look(frames), 5, stride=1, padding=2).flatten(1)  # (B, H W)
