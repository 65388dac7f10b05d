"""FORBES: learn, evaluate and use belief states of partially observable processes.

Public names are imported on first use (PEP 562), so that `import forbes` and `forbes --help` do not import torch.
`__init__.pyi` declares the same names for type checkers.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "beliefs": "CategoricalBelief FlowBelief GaussianBelief MixtureBelief",
    "data": "Episode EpisodeWriter Experience Replay SequenceBatch SequenceDataModule Simulated Strokes",
    "envs": "DeepMindControl Gymnasium find_environment",
    "errors": "ForbesError",
    "evaluation": "CalibrationError ELBO PLL complete evaluate filter imagine",
    "models": "Bernoulli ConvDecoder ConvEncoder MLPDecoder MLPEncoder ModelAdapter ModelParts Normal OneHot "
    "OnePixel ParticleModel PartsDecoder PartsEncoder PartsLikelihood PixelDecoder PixelEncoder State StateSpaceModel "
    "SymlogNormal VectorModel VectorNormal",
    "pomdps": "LightDark LinearGaussian MirrorSensor MountainHike TMaze Tiger Ungm",
    "training": "ImaginationActorCritic KnownBelief PlanningAgent WorldModel",
    "training.loading": "load_run",
}
MODULES = {name: f"forbes.{part}" for part, names in _PUBLIC.items() for name in names.split()}
"""Module of each public name."""

__all__ = ["MODULES", "__version__", *MODULES]


def __getattr__(name: str) -> Any:
    """Import a public name."""
    if name not in MODULES:
        raise AttributeError(f"module 'forbes' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    """Return all public names, including those not imported yet."""
    return sorted({*globals(), *MODULES})
