"""Belief families: conditional densities over the stochastic state, one file each, all through `BeliefHead`."""

from forbes.beliefs.base import BeliefFamily, BeliefHead
from forbes.beliefs.categorical import CategoricalBelief
from forbes.beliefs.flow import FlowBelief
from forbes.beliefs.gaussian import GaussianBelief
from forbes.beliefs.mixture import MixtureBelief

__all__ = [
    "BeliefFamily",
    "BeliefHead",
    "CategoricalBelief",
    "FlowBelief",
    "GaussianBelief",
    "MixtureBelief",
]
