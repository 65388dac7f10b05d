"""Environments for agents, with one small interface, and a worker process that runs one.

Simulators, torch and gymnasium are imported only when they are needed, so a worker starts in a fraction of a second.
"""

from forbes.envs.base import TIME_LIMIT, Environment, Step
from forbes.envs.dm_control import DeepMindControl
from forbes.envs.gymnasium import Gymnasium
from forbes.envs.tasks import find_environment
from forbes.envs.worker import BrokenEnvironmentError, EnvironmentProcess

__all__ = [
    "TIME_LIMIT",
    "BrokenEnvironmentError",
    "DeepMindControl",
    "Environment",
    "EnvironmentProcess",
    "Gymnasium",
    "Step",
    "find_environment",
]
