"""Environments an agent acts in, behind one small interface, and the process that owns one.

Nothing here imports a simulator, torch or gymnasium before it is asked for: a worker starts in a fraction of a second.
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
