"""Training: LightningModules that optimise and log."""

from forbes.training.known_model import KnownBelief
from forbes.training.world_model import WorldModel

__all__ = ["KnownBelief", "WorldModel"]
