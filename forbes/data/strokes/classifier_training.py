"""Train the digit classifiers from strokes, and say how good they are: `forbes data build-classifiers`.

They learn from the training digits; the prefix classifiers are calibrated on the validation digits; all are measured on
the test digits, which decide nothing.
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
from forbes.seeding import derive_seed, generator

__all__ = ["Digits", "Quality", "calibrate", "classify", "digits_of", "draw_finished", "draw_prefix", "fit", "quality"]
__all__ += ["train_classifiers"]

_NEVER = 255  # the longest digit has 106 points
_FINISHED_EPOCHS, _PREFIX_EPOCHS, _SEED = 7, 6, 0
_BATCH = 128
_RATE = 3e-3
_SHIFT = 2  # pixels
_CALIBRATED = (5, 10, 15, 20, 25, 30)  # points


class Digits(NamedTuple):
    """Digits of a split, in a form from which any of their frames is one comparison."""

    first_visit: Tensor
    """The point that first visits each pixel, counted from 0; 255 for none, uint8 (N, H * W)."""
    points: Tensor
    """How many points each digit has, int64 (N,)."""
    labels: Tensor
    """int64 (N,)."""

    def take(self, index: Tensor) -> "Digits":
        """Choose digits by index or by mask, `(N,)`."""
        return Digits(*(values[index] for values in self))

    def frames(self, points: Tensor) -> Tensor:
        """Draw the first so many points of each digit, `(N,)` to float32 `(N, 1, H, W)`."""
        return (self.first_visit < points[:, None]).float().view(-1, 1, SIDE, SIDE)  # (N, 1, H, W)

    def histories(self, points: Tensor) -> Tensor:
        """Draw the same frame, and the mean of all up to it, `(N,)` to float32 `(N, 2, H, W)`."""
        shown = (points[:, None] - self.first_visit.long()).clamp(min=0)  # (N, H * W), frames that show the pixel
        mean = (shown / points[:, None]).view(-1, 1, SIDE, SIDE)  # (N, 1, H, W)
        return torch.cat((self.frames(points), mean), 1)  # (N, 2, H, W)


def train_classifiers(sources: Mapping[str, Strokes]) -> dict[str, DigitClassifier]:
    """Train a finished classifier of all sets together, and a calibrated prefix classifier of each.

    Args:
        sources: sets of strokes by their name.

    Returns:
        `finished`, and `prefix-NAME` of each set; weights rounded to half precision, as they are stored.
    """
    train = {name: digits_of(source, "train") for name, source in sources.items()}
    together = Digits(*(torch.cat(values) for values in zip(*train.values(), strict=True)))
    classifiers = {"finished": fit(together, draw_finished, _FINISHED_EPOCHS, _SEED)}
    for name, source in sources.items():
        classifiers[f"prefix-{name}"] = fit(train[name], draw_prefix, _PREFIX_EPOCHS, _SEED)
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
    first_visit[digit[::-1], pixel[::-1]] = order[::-1]  # of several values for a place the last one stays
    return Digits(torch.from_numpy(first_visit), torch.from_numpy(points).long(), source.labels(split))


def fit(digits: Digits, draw: Callable[[Digits], tuple[Tensor, Tensor]], epochs: int, seed: int) -> DigitClassifier:
    """Train a classifier by maximum likelihood: Adam, the rate falling along a cosine.

    Args:
        digits: to learn from.
        draw: what it sees of digits and what it is to say, `draw_finished` or `draw_prefix`; anew for each batch.
        epochs: passes over the digits.
        seed: of the weights and of all that is drawn.
    """
    size = len(digits.labels)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "digit classifier", 0))
        classifier = DigitClassifier(draw(digits.take(torch.arange(1)))[0].shape[1])
        optimizer = torch.optim.Adam(classifier.parameters(), _RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs * (size // _BATCH))
        for index in _batches(size, epochs, seed):
            frames, shares = draw(digits.take(index))
            loss = -(shares * classifier(frames)).sum(1).mean()
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
    """Draw whole digits, worn, shifted alike by up to two pixels, and half of them blended.

    A blend is of the digit, the next one and the mean of all, in random shares; its classes have the same shares. So a
    drawing of two modes is not taken for one of them.

    Returns:
        Frames, `(N, 1, H, W)`, and the shares of the classes, `(N, 10)`.
    """
    shift = torch.randint(-_SHIFT, _SHIFT + 1, (2,)).tolist()
    frames = _augment(digits.frames(digits.points)).roll(shift, (2, 3))
    share = torch.distributions.Dirichlet(torch.ones(3)).sample((len(frames),)).T  # (3, N)
    share[:, : len(frames) // 2] = torch.eye(3)[:, :1]
    return _blend(frames, share), _blend(_shares(digits), share)


def _blend(values: Tensor, share: Tensor) -> Tensor:
    parts = torch.stack((values, values.roll(1, 0), values.mean(0, keepdim=True).expand_as(values)))  # (3, N, ...)
    return torch.einsum("kn,kn...->n...", share, parts)


def _shares(digits: Digits) -> Tensor:
    return one_hot(digits.labels, CLASSES).float()  # (N, 10)


def draw_prefix(digits: Digits) -> tuple[Tensor, Tensor]:
    """Draw the beginnings of digits, of a random number of points each, worn, `(N, 2, H, W)`, with their classes."""
    points = 1 + (torch.rand(len(digits.points)) * digits.points).long()  # (N,)
    return _augment(digits.histories(points)), _shares(digits)


def _augment(frames: Tensor) -> Tensor:
    """Wear strokes as a model may: up to a tenth of the pixels lost, up to half of the ink spread over neighbours."""
    lost, spread = 0.1 * torch.rand(len(frames), 1, 1, 1), 0.5 * torch.rand(len(frames), 1, 1, 1)
    kept = frames * (torch.rand_like(frames[:, :1]) >= lost)  # (N, C, H, W)
    return (1 - spread) * kept + spread * avg_pool2d(kept, 3, stride=1, padding=1)


@torch.no_grad()
def classify(classifier: DigitClassifier, digits: Digits, points: int | None) -> tuple[Tensor, Tensor]:
    """Classify whole digits, or the beginnings of those that have more than so many points.

    Args:
        classifier: finished or prefix.
        digits: N of them.
        points: of the beginning; None for whole digits.

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
    """Divide a prefix classifier's logits by the temperature that predicts these digits best (arXiv 1706.04599)."""
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
    """How good a classifier is on digits that it has not seen."""

    digits: int
    accuracy: float
    nll: float
    """In nats."""
    calibration_error: float


def quality(log_probs: Tensor, labels: Tensor) -> Quality:
    """Measure what `classify` gives."""
    accuracy = (log_probs.argmax(1) == labels).double().mean().item()
    return Quality(
        len(labels), accuracy, nll_loss(log_probs, labels).item(), calibration_error(log_probs.exp(), labels)
    )
