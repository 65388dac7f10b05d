r"""Classifiers of digits: the class of a finished drawing, and the future class of an unfinished one.

.. math:: \text{finished } p(y \mid o), \qquad
          \text{prefix } p\Big(y \,\Big|\, o_t, \frac1t \sum_{\tau \le t} o_\tau\Big) = p(y \mid o_{1:t})

Both are small convolutional networks trained on strokes (`forbes data build-classifiers`) and bundled in
`classifiers.npz`. Frames are cumulative, so their mean over time shows when each pixel was drawn: the prefix classifier
has all the information that a model has. It is calibrated, so that it can serve as the true class distribution given a
prefix. There is one for each set of strokes, since the sets differ in the order of writing. The finished classifier is
trained on both sets, with strokes that are shifted, broken or grey, as those of a model may be.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from forbes.bundled import bundled
from forbes.errors import ForbesError
from forbes.files import npz_bytes, replace_file
from forbes.reading import read_npz

__all__ = [
    "CLASSES",
    "CLASSIFIERS_SHA256",
    "DigitClassifier",
    "DigitClassifiers",
    "calibration_error",
    "classifiers_path",
]
__all__ += ["load_classifiers", "save_weights"]

CLASSES = 10
CLASSIFIERS_SHA256 = "814ad34e76ac09d430373f9695a8aaee6cc9fd58e5fdabe9ce6da12f6e31933f"
"""SHA-256 of the weights of this version."""

_CHANNELS = (16, 32, 64)
_WIDTH = 64
_BINS = 10


class DigitClassifier(nn.Module):
    """Log-probabilities of the ten classes: three convolutions of stride 2 and a hidden layer.

    Args:
        channels: number of input channels: 1 for the finished classifier (a frame), 2 for the prefix classifier (the
            last frame and the mean frame).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, second, third = _CHANNELS
        self.net = nn.Sequential(
            *(nn.Conv2d(channels, first, 5, stride=2, padding=2), nn.ReLU()),  # 14 pixels
            *(nn.Conv2d(first, second, 3, stride=2, padding=1), nn.ReLU()),  # 7
            *(nn.Conv2d(second, third, 3, stride=2, padding=1), nn.ReLU()),  # 4
            *(nn.Flatten(), nn.Linear(16 * third, _WIDTH), nn.ReLU()),
            nn.Linear(_WIDTH, CLASSES),
        )

    def forward(self, frames: Tensor) -> Tensor:
        """Return log p(y | frames) in nats, `(*, 10)`, for grey values in [0, 1], `(*, C, H, W)`."""
        logits: Tensor = self.net(frames.flatten(0, -4).float())  # (N, 10)
        return logits.log_softmax(-1).view(*frames.shape[:-3], CLASSES)  # (*, 10)


class DigitClassifiers(NamedTuple):
    """The two classifiers for a set of strokes."""

    finished: DigitClassifier
    prefix: DigitClassifier


def classifiers_path() -> Path:
    """Return the path of the bundled weights."""
    return bundled("classifiers.npz")


def load_classifiers(origin: Literal["bundled", "dejong"]) -> DigitClassifiers:
    """Load the classifiers for a set of strokes, in evaluation mode on the CPU.

    Raises:
        ForbesError: if the file is missing, damaged, or of another version.
    """
    path = classifiers_path()
    remedy = "Restore it from the repository, or reinstall forbes"
    if not path.is_file():
        raise ForbesError(f"{path}: no such file. {remedy}")
    weights = read_npz(path, remedy)
    if (found := _sha256(weights)) != CLASSIFIERS_SHA256:
        raise ForbesError(f"{path}: weights of sha256 {found[:16]}…, expected {CLASSIFIERS_SHA256[:16]}…. {remedy}")
    classifiers = DigitClassifiers(DigitClassifier(1), DigitClassifier(2))
    for classifier, name in zip(classifiers, ("finished", f"prefix-{origin}"), strict=True):
        classifier.load_state_dict(
            {key: torch.from_numpy(weights[f"{name}.{key}"]).float() for key in classifier.state_dict()}
        )
        classifier.eval().requires_grad_(False)
    return classifiers


def save_weights(path: Path, classifiers: Mapping[str, DigitClassifier]) -> str:
    """Write the classifiers' weights in half precision, and return their hash."""
    weights = {
        f"{name}.{key}": values.numpy().astype(np.float16)
        for name, classifier in classifiers.items()
        for key, values in classifier.state_dict().items()
    }
    replace_file(path, npz_bytes(weights))
    return _sha256(weights)


def _sha256(weights: Mapping[str, NDArray[Any]]) -> str:
    """Hash names, shapes and bytes, independent of the file's compression."""
    digest = hashlib.sha256()
    for name, array in sorted(weights.items()):
        digest.update(f"{name} {array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def calibration_error(probabilities: Tensor, labels: Tensor) -> float:
    r"""Return the expected calibration error (ECE, arXiv 1706.04599), over ten equal bins b of the confidence.

    .. math:: \frac1N \sum_b \Big|\sum_{i \in b} 1[\hat y_i = y_i] - \hat p_i\Big|

    Args:
        probabilities: class probabilities, `(N, 10)`. The largest, :math:`\hat p_i`, is the confidence of the
            prediction :math:`\hat y_i`.
        labels: true classes, `(N,)`.
    """
    confidence, choice = probabilities.double().max(1)  # (N,), (N,)
    bins = (confidence * _BINS).long().clamp(max=_BINS - 1)  # (N,)
    surplus = (choice == labels).double() - confidence  # (N,)
    return surplus.new_zeros(_BINS).index_add(0, bins, surplus).abs().sum().item() / len(labels)
