"""State-space models as pure modules: they compute and return records, and never log."""

from forbes.models.base import BeliefModel, EncodedSequence, ModelFamily, ModelParts, Rollout, State
from forbes.models.elbo import ElboTerms, elbo_loss
from forbes.models.likelihoods import Bernoulli, Likelihood, Normal, OneHot, OnePixel, SymlogNormal, VectorNormal
from forbes.models.networks import ConvDecoder, ConvEncoder, MLPDecoder, MLPEncoder
from forbes.models.particles import ParticleModel
from forbes.models.pixels import PixelDecoder, PixelEncoder
from forbes.models.state_space import Filtered, StateSpaceModel
from forbes.models.vector import VectorModel

__all__ = [
    "BeliefModel",
    "Bernoulli",
    "ConvDecoder",
    "ConvEncoder",
    "ElboTerms",
    "EncodedSequence",
    "Filtered",
    "Likelihood",
    "MLPDecoder",
    "MLPEncoder",
    "ModelFamily",
    "ModelParts",
    "Normal",
    "OneHot",
    "OnePixel",
    "ParticleModel",
    "PixelDecoder",
    "PixelEncoder",
    "Rollout",
    "State",
    "StateSpaceModel",
    "SymlogNormal",
    "VectorModel",
    "VectorNormal",
    "elbo_loss",
]
