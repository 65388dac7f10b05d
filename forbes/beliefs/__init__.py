"""Belief families: conditional densities over the stochastic state, one per file. All derive from `BeliefHead`."""

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
