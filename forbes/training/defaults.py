"""Defaults of a world model by its data: the values of `configs/`."""

from collections.abc import Mapping
from typing import Any

from forbes.beliefs import FlowBelief
from forbes.data import SequenceSource, Simulated, Strokes
from forbes.models import (
    Bernoulli,
    ConvDecoder,
    ConvEncoder,
    MLPDecoder,
    MLPEncoder,
    Normal,
    OneHot,
    OnePixel,
    PartsDecoder,
    PartsEncoder,
    PartsLikelihood,
    PixelDecoder,
    PixelEncoder,
    VectorNormal,
)
from forbes.pomdps.hmm import FiniteProcess

__all__ = ["defaults_for"]


def defaults_for(source: SequenceSource) -> dict[str, Any]:
    """Return arguments of `WorldModel` that fit a source. All others keep the default of the class.

    Digit strokes have those of `configs/strokes/forbes.yaml` where a frame has at most one pixel, otherwise those of
    `configs/strokes/whole/forbes.yaml`. Known processes have those of `configs/pomdp`, with one-hot or normal
    observations. Other vectors have MLPs and a normal likelihood. Other images keep the defaults of the class, those of
    DeepMind Control. Each of several parts has those of its kind.
    """
    if isinstance(source, Strokes):
        return _one_pixel() if source.increments and source.points_per_step == 1 else _whole_frames()
    if isinstance(source, Simulated):
        return _process(finite=isinstance(source.process, FiniteProcess))
    if isinstance(source.observation_shape, Mapping):
        return _parts(source.observation_shape)
    if len(source.observation_shape) == 1:
        return {"encoder": MLPEncoder, "decoder": MLPDecoder, "likelihood": VectorNormal()}
    return {}


def _parts(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    images = {name: len(shape) == 3 for name, shape in shapes.items()}
    return {
        "encoder": PartsEncoder.configured(parts={n: ConvEncoder if images[n] else MLPEncoder for n in images}),
        "decoder": PartsDecoder.configured(parts={n: ConvDecoder if images[n] else MLPDecoder for n in images}),
        "likelihood": PartsLikelihood({n: Normal() if images[n] else VectorNormal() for n in images}),
    }


def _one_pixel() -> dict[str, Any]:
    networks = {"encoder": PixelEncoder, "decoder": PixelDecoder, "likelihood": OnePixel()}
    return {"belief": FlowBelief.configured(layers=4), **networks, **_of_strokes()}


def _whole_frames() -> dict[str, Any]:
    return {
        "belief": FlowBelief.configured(layers=3, width=32),
        "encoder": MLPEncoder.configured(width=512, layers=1),
        "decoder": MLPDecoder.configured(width=512, layers=1, output_bias=-4),
        "likelihood": Bernoulli(),
        **_of_strokes(),
    }


def _of_strokes() -> dict[str, Any]:
    return {"state_dim": 8, "mlp_layers": 1, "free_nats": 0, "kl_warmup": 500} | _rate(6e-3, warmup=200)


def _process(finite: bool) -> dict[str, Any]:
    sizes = {"state_dim": 4, "hidden_dim": 64, "mlp_dim": 64, "mlp_layers": 1}
    return {
        "belief": FlowBelief.configured(layers=3, width=32),
        "encoder": MLPEncoder.configured(width=64, layers=1),
        "decoder": MLPDecoder.configured(width=64, layers=1),
        "likelihood": OneHot() if finite else VectorNormal(),
        **sizes,
        **{"free_nats": 0, "kl_warmup": 200},
        **_rate(3e-3, warmup=100),
    }


def _rate(learning_rate: float, warmup: int) -> dict[str, Any]:
    return {"learning_rate": learning_rate, "schedule": "cosine", "warmup": warmup}
