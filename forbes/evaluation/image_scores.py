r"""PSNR and SSIM of open-loop predictions of images, by the number of steps after the last observation.

The prediction is the mean of K futures, an estimate of :math:`\hat o_{c+h} = E[o_{c+h} \mid o_{1:c}]`. If observations
are increments, images are the drawings so far. The reference repeats the last observed frame. Values are in [0, 1];
higher is better.

.. math:: \mathrm{PSNR}_h = -10 \log_{10} \overline{(o_{c+h} - \hat o_{c+h})^2}

in dB, with the mean over sequences and pixels. SSIM, at most 1, is the mean over sequences of the structural similarity
(Wang et al., 2004). Both measure the mean of the predictions, and hedging maximises the PSNR. So neither is a score of
the belief; the open-loop log-likelihood is.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch
from torch import Tensor

from forbes.data import SequenceBatch, SequenceSource
from forbes.evaluation.predictions import expected_frames
from forbes.models import BeliefModel
from forbes.seeding import derive_seed, forked

if TYPE_CHECKING:
    from torchmetrics import MetricCollection

__all__ = ["ImageScores", "futures_of", "image_curves", "image_rows", "score_images"]

_FUTURES = 100  # a hundredth of their variance is left in the squared error, 0.04 dB at most
_FRAMES = 1000  # frames of one future at a time
_SMALLEST = 6  # pixels; the window of SSIM has 11, and the image is mirrored at its edges


class ImageScores(NamedTuple):
    """Scores at 1, 2, … steps after the last observation."""

    psnr: list[float]
    """In dB; infinite for a prediction without error."""
    ssim: list[float] | None
    """None for images of less than 6 pixels a side."""


def futures_of(model: BeliefModel, wanted: int) -> int:
    """Return the number of futures to average: at most 100 and at most `wanted`, in whole sets of particles."""
    return min(wanted, max(1, _FUTURES // model.particles) * model.particles)


def image_rows(steps: int) -> int:
    """Return the number of sequences per batch if `steps` are predicted."""
    return max(1, _FRAMES // steps)


@torch.no_grad()
def score_images(
    model: BeliefModel,
    source: SequenceSource,
    batches: Iterable[tuple[int, SequenceBatch]],
    context: int,
    futures: int,
    seed: int = 0,
) -> dict[str, ImageScores]:
    """Score the model, as "model", and the last observed frame, as "last frame".

    Args:
        model: model in eval mode. Predictions are computed on its device.
        source: source of the batches, of images.
        batches: index of the first sequence of each batch, and the batch on the CPU.
        context: number of steps that the model observes, c.
        futures: number of futures whose mean is the prediction, K (see `futures_of`).
        seed: random seed of the futures, which depend on nothing else but the batches.
    """
    device, kinds = next(model.parameters()).device, ["psnr"]
    shape = source.observation_shape
    if isinstance(shape, tuple) and min(shape[1:]) >= _SMALLEST:
        kinds.append("ssim")
    found: dict[str, list[MetricCollection]] = {"model": [], "last frame": []}
    for first, batch in batches:
        batch = batch.to(device)
        with forked(device, derive_seed(seed, "image scores", first)):
            expected = expected_frames(model, source, batch, context, futures)  # (B, T - c, C, H, W)
        truth = source.pictures(model.likelihood.picture(batch.observation)).float()  # (B, T, C, H, W)
        last = truth[:, context - 1 : context].expand_as(expected)
        for name, predicted in (("model", expected), ("last frame", last)):
            _update(found[name], kinds, predicted, truth[:, context:], batch.mask[:, context:])
    return {name: _computed(metrics) for name, metrics in found.items()}


def image_curves(found: Mapping[str, ImageScores]) -> Iterator[tuple[str, str, dict[str, list[float | None]]]]:
    """Yield name, unit and curves of both scores, for JSON: the curve of each predictor, None where it is infinite."""
    for metric, unit in (("psnr", "dB"), ("ssim", "1")):
        curves = {name: getattr(scores, metric) for name, scores in found.items()}
        if None not in curves.values():
            yield (
                metric,
                unit,
                {name: [value if math.isfinite(value) else None for value in curve] for name, curve in curves.items()},
            )


def _update(
    metrics: list["MetricCollection"], kinds: list[str], predicted: Tensor, truth: Tensor, mask: Tensor
) -> None:
    """Add predictions `(B, H, C, H, W)` of the steps that count, bool `(B, H)`, to the metrics of each horizon."""
    for horizon in range(int(mask.any(0).sum())):
        if horizon == len(metrics):
            metrics.append(_metrics(kinds).to(mask.device))
        rows = mask[:, horizon]
        metrics[horizon].update(predicted[rows, horizon].float(), truth[rows, horizon])


def _metrics(kinds: list[str]) -> "MetricCollection":
    from torchmetrics import MetricCollection  # only where images are scored: it imports scipy.signal
    from torchmetrics.image import PeakSignalNoiseRatio, StructuralSimilarityIndexMeasure

    of_kind = {"psnr": PeakSignalNoiseRatio, "ssim": StructuralSimilarityIndexMeasure}
    return MetricCollection({kind: of_kind[kind](data_range=1.0) for kind in kinds})


def _computed(metrics: list["MetricCollection"]) -> ImageScores:
    computed = [{kind: value.item() for kind, value in cast(Any, each).compute().items()} for each in metrics]
    ssim = [values["ssim"] for values in computed if "ssim" in values]
    return ImageScores([values["psnr"] for values in computed], ssim or None)
