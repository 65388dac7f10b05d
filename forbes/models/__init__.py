"""State-space models as pure modules: they compute and return records, and never log."""

from forbes.models.elbo import ElboTerms, elbo_loss
from forbes.models.likelihoods import Bernoulli, Likelihood, Normal, OneHot, VectorNormal
from forbes.models.networks import ConvDecoder, ConvEncoder, MLPDecoder, MLPEncoder
from forbes.models.state_space import Filtered, Rollout, State, StateSpaceModel

__all__ = [
    "Bernoulli",
    "ConvDecoder",
    "ConvEncoder",
    "ElboTerms",
    "Filtered",
    "Likelihood",
    "MLPDecoder",
    "MLPEncoder",
    "Normal",
    "OneHot",
    "Rollout",
    "State",
    "StateSpaceModel",
    "VectorNormal",
    "elbo_loss",
]
