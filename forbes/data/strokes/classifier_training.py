"""Train and evaluate the digit classifiers: `forbes data build-classifiers`.

All are trained on the training digits. The prefix classifiers are calibrated on the validation digits. Test digits are
used for the final scores only.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, nll_loss, one_hot

from forbes.data.source import Split
from forbes.data.strokes.classifiers import CLASSES, DigitClassifier, calibration_error
from forbes.data.strokes.file import SIDE
from forbes.data.strokes.source import Strokes
from forbes.seeding import derive_seed, forked, generator

__all__ = ["Digits", "Quality", "calibrate", "classify", "digits_of", "draw_finished", "draw_prefix", "quality"]
__all__ += ["fit_classifier", "train_classifiers"]

_NEVER = 255  # the longest digit has 106 points
_FINISHED_EPOCHS, _PREFIX_EPOCHS, _SEED = 7, 6, 0
_BATCH = 128
_RATE = 3e-3
_SHIFT = 2  # pixels
_CALIBRATED = (5, 10, 15, 20, 25, 30)  # points


class Digits(NamedTuple):
    """Digits of a split, stored such that any frame is one comparison."""

    first_visit: Tensor
    """Index of the point that first visits each pixel, from 0; 255 for none, uint8 (N, H * W)."""
    points: Tensor
    """Number of points of each digit, int64 (N,)."""
    labels: Tensor
    """Class of each digit, int64 (N,)."""

    def take(self, index: Tensor) -> "Digits":
        """Return digits by index or by mask, `(N,)`."""
        return Digits(*(values[index] for values in self))

    def frames(self, points: Tensor) -> Tensor:
        """Render the first `points` points of each digit, `(N,)` to float32 `(N, 1, H, W)`."""
        return (self.first_visit < points[:, None]).float().view(-1, 1, SIDE, SIDE)  # (N, 1, H, W)

    def histories(self, points: Tensor) -> Tensor:
        """Render the same frame, and the mean of all frames up to it, `(N,)` to float32 `(N, 2, H, W)`."""
        shown = (points[:, None] - self.first_visit.long()).clamp(min=0)  # (N, H * W), frames that show the pixel
        mean = (shown / points[:, None]).view(-1, 1, SIDE, SIDE)  # (N, 1, H, W)
        return torch.cat((self.frames(points), mean), 1)  # (N, 2, H, W)


def train_classifiers(sources: Mapping[str, Strokes]) -> dict[str, DigitClassifier]:
    """Train one classifier of finished digits for all sets, and a calibrated prefix classifier for each set.

    Args:
        sources: sets of strokes by name.

    Returns:
        `finished`, and `prefix-NAME` for each set, with weights rounded to half precision, as they are stored.
    """
    train = {name: digits_of(source, "train") for name, source in sources.items()}
    together = Digits(*(torch.cat(values) for values in zip(*train.values(), strict=True)))
    classifiers = {"finished": fit_classifier(together, draw_finished, _FINISHED_EPOCHS, _SEED)}
    for name, source in sources.items():
        classifiers[f"prefix-{name}"] = fit_classifier(train[name], draw_prefix, _PREFIX_EPOCHS, _SEED)
        calibrate(classifiers[f"prefix-{name}"], digits_of(source, "validation"))
    return {name: classifier.half().float() for name, classifier in classifiers.items()}


def digits_of(source: Strokes, split: Split) -> Digits:
    """Return the digits of a split."""
    arrays = source.arrays(split)
    points = np.diff(arrays.offsets)  # (N,)
    digit = np.repeat(np.arange(len(points)), points)  # (P,)
    order = np.arange(len(digit)) - np.repeat(arrays.offsets[:-1], points)  # (P,)
    pixel = arrays.points[:, 1].astype(np.int64) * SIDE + arrays.points[:, 0]  # (P,)
    first_visit = np.full((len(points), SIDE * SIDE), _NEVER, np.uint8)
    first_visit[digit[::-1], pixel[::-1]] = order[::-1]  # reversed, so that the first visit is assigned last
    return Digits(torch.from_numpy(first_visit), torch.from_numpy(points).long(), source.labels(split))


def fit_classifier(
    digits: Digits, draw: Callable[[Digits], tuple[Tensor, Tensor]], epochs: int, seed: int
) -> DigitClassifier:
    """Train a classifier by maximum likelihood, with Adam and a cosine schedule.

    Args:
        digits: training digits.
        draw: function that samples inputs and targets for each batch, `draw_finished` or `draw_prefix`.
        epochs: number of passes over the digits.
        seed: random seed for weights and samples.
    """
    size = len(digits.labels)
    with forked("cpu", derive_seed(seed, "digit classifier", 0)):
        classifier = DigitClassifier(draw(digits.take(torch.arange(1)))[0].shape[1])
        optimizer = torch.optim.Adam(classifier.parameters(), _RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs * (size // _BATCH))
        for index in _batches(size, epochs, seed):
            frames, targets = draw(digits.take(index))
            loss = -(targets * classifier(frames)).sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return classifier.eval()


def _batches(size: int, epochs: int, seed: int) -> Iterator[Tensor]:
    for epoch in range(epochs):
        order = torch.randperm(size, generator=generator(seed, "digit classifier order", epoch))
        yield from order[: size // _BATCH * _BATCH].split(_BATCH)


def draw_finished(digits: Digits) -> tuple[Tensor, Tensor]:
    """Render whole digits, augmented, shifted together by up to two pixels, and half of them blended.

    A blend is a random mixture of the digit, the next digit and the mean digit. Its target is the same mixture of their
    classes, so that the classifier is uncertain about a mixture of two modes.

    Returns:
        Frames, `(N, 1, H, W)`, and target probabilities of the classes, `(N, 10)`.
    """
    shift = torch.randint(-_SHIFT, _SHIFT + 1, (2,)).tolist()
    frames = _augment(digits.frames(digits.points)).roll(shift, (2, 3))
    weight = torch.distributions.Dirichlet(torch.ones(3)).sample((len(frames),)).T  # (3, N)
    weight[:, : len(frames) // 2] = torch.eye(3)[:, :1]
    return _blend(frames, weight), _blend(_targets(digits), weight)


def _blend(values: Tensor, weight: Tensor) -> Tensor:
    parts = torch.stack((values, values.roll(1, 0), values.mean(0, keepdim=True).expand_as(values)))  # (3, N, ...)
    return torch.einsum("kn,kn...->n...", weight, parts)


def _targets(digits: Digits) -> Tensor:
    return one_hot(digits.labels, CLASSES).float()  # (N, 10)


def draw_prefix(digits: Digits) -> tuple[Tensor, Tensor]:
    """Render augmented prefixes of random length, `(N, 2, H, W)`, and return them with their target classes."""
    points = 1 + (torch.rand(len(digits.points)) * digits.points).long()  # (N,)
    return _augment(digits.histories(points)), _targets(digits)


def _augment(frames: Tensor) -> Tensor:
    """Degrade strokes as a model may: drop up to a tenth of the pixels, spread up to half of the ink to neighbours."""
    lost, spread = 0.1 * torch.rand(len(frames), 1, 1, 1), 0.5 * torch.rand(len(frames), 1, 1, 1)
    kept = frames * (torch.rand_like(frames[:, :1]) >= lost)  # (N, C, H, W)
    return (1 - spread) * kept + spread * avg_pool2d(kept, 3, stride=1, padding=1)


@torch.no_grad()
def classify(classifier: DigitClassifier, digits: Digits, points: int | None) -> tuple[Tensor, Tensor]:
    """Classify whole digits, or the prefixes of those that have more points than the prefix.

    Args:
        classifier: classifier of finished digits or of prefixes.
        digits: N digits.
        points: number of points of the prefix; None for whole digits.

    Returns:
        Log-probabilities in nats, `(M, 10)`, and labels, `(M,)`, of the M digits that are long enough.
    """
    if points is not None:
        digits = digits.take(digits.points > points)
    found = []
    for index in torch.arange(len(digits.labels)).split(1000):
        part = digits.take(index)
        frames = part.frames(part.points) if points is None else part.histories(torch.full_like(part.points, points))
        found.append(classifier(frames))
    return torch.cat(found), digits.labels


def calibrate(classifier: DigitClassifier, digits: Digits) -> float:
    """Scale a prefix classifier's logits by the temperature of the highest likelihood (arXiv 1706.04599)."""
    parts = [classify(classifier, digits, points) for points in _CALIBRATED]
    found, labels = (torch.cat(values) for values in zip(*parts, strict=True))  # (N, 10), (N,)
    candidates = torch.linspace(math.log(0.5), math.log(2), 201).exp().tolist()
    losses = [nll_loss((found / temperature).log_softmax(-1), labels).item() for temperature in candidates]
    temperature = float(candidates[losses.index(min(losses))])
    with torch.no_grad():
        for parameter in classifier.net[-1].parameters():
            parameter.div_(temperature)
    return temperature


class Quality(NamedTuple):
    """Scores of a classifier on held-out digits."""

    digits: int
    """Number of digits."""
    accuracy: float
    nll: float
    """Mean negative log-likelihood of the class in nats."""
    calibration_error: float


def quality(log_probs: Tensor, labels: Tensor) -> Quality:
    """Score the output of `classify`."""
    accuracy = (log_probs.argmax(1) == labels).double().mean().item()
    return Quality(
        len(labels), accuracy, nll_loss(log_probs, labels).item(), calibration_error(log_probs.exp(), labels)
    )
