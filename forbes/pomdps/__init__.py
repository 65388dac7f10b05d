"""Partially observable processes with an exactly known belief, one file each, with the interface `Process`."""

from forbes.pomdps.base import AffineGaussian, ExactFilter, Process, Trajectories
from forbes.pomdps.beliefs import ExactBelief, FiniteBelief, GaussianMixtureBelief, GridBelief
from forbes.pomdps.light_dark import LightDark
from forbes.pomdps.linear_gaussian import LinearGaussian
from forbes.pomdps.mirror_sensor import MirrorSensor
from forbes.pomdps.mountain_hike import MountainHike
from forbes.pomdps.t_maze import TMaze
from forbes.pomdps.tiger import Tiger
from forbes.pomdps.ungm import Ungm

__all__ = [
    "AffineGaussian",
    "ExactBelief",
    "ExactFilter",
    "FiniteBelief",
    "GaussianMixtureBelief",
    "GridBelief",
    "LightDark",
    "LinearGaussian",
    "MirrorSensor",
    "MountainHike",
    "Process",
    "TMaze",
    "Tiger",
    "Trajectories",
    "Ungm",
]
