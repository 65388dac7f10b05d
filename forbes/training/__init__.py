"""Training: LightningModules that optimise and log."""

from forbes.training.world_model import WorldModel

__all__ = ["WorldModel"]
