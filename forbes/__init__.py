"""FORBES: learn, measure and use belief states of partially observable processes.

Every public name is imported when it is first used (PEP 562), so that `import forbes` and `forbes --help` need no
torch. `__init__.pyi` tells the same names to type checkers.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "beliefs": "CategoricalBelief FlowBelief GaussianBelief MixtureBelief",
    "data": "Experience Replay SequenceBatch SequenceDataModule Simulated Strokes",
    "envs": "DeepMindControl Gymnasium find_environment",
    "errors": "ForbesError",
    "evaluation": "complete evaluate filter imagine",
    "models": "Bernoulli ConvDecoder ConvEncoder MLPDecoder MLPEncoder ModelParts Normal OneHot OnePixel "
    "ParticleModel PixelDecoder PixelEncoder StateSpaceModel VectorModel VectorNormal",
    "pomdps": "LightDark LinearGaussian MirrorSensor MountainHike TMaze Tiger Ungm",
    "training": "ImaginationActorCritic KnownBelief PlanningAgent WorldModel",
    "training.loading": "load_run",
}
MODULES = {name: f"forbes.{part}" for part, names in _PUBLIC.items() for name in names.split()}
"""Where each public name is imported from."""

__all__ = ["MODULES", "__version__", *MODULES]


def __getattr__(name: str) -> Any:
    """Import a public name."""
    if name not in MODULES:
        raise AttributeError(f"module 'forbes' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *MODULES})
