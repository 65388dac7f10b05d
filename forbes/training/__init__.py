"""Training: LightningModules that optimise and log."""

from forbes.training.actor_critic import ImaginationActorCritic
from forbes.training.known_belief import KnownBelief
from forbes.training.planning_agent import PlanningAgent
from forbes.training.world_model import WorldModel

__all__ = ["ImaginationActorCritic", "KnownBelief", "PlanningAgent", "WorldModel"]
