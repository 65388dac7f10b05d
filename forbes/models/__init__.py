"""State-space models as pure modules: they compute and return records, and never log."""

from forbes.models.adapter import ModelAdapter
from forbes.models.base import BeliefModel, EncodedSequence, ModelFamily, ModelParts, RecurrentModel, Rollout, State
from forbes.models.elbo import ElboTerms, elbo_loss
from forbes.models.likelihoods import Bernoulli, Likelihood, Normal, OneHot, OnePixel, SymlogNormal, VectorNormal
from forbes.models.networks import ConvDecoder, ConvEncoder, MLPDecoder, MLPEncoder
from forbes.models.particles import ParticleModel
from forbes.models.parts import PartsDecoder, PartsEncoder, PartsLikelihood
from forbes.models.pixels import PixelDecoder, PixelEncoder
from forbes.models.posterior import Filtered, PosteriorModel, has_posterior
from forbes.models.state_space import StateSpaceModel
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
    "ModelAdapter",
    "ModelFamily",
    "ModelParts",
    "Normal",
    "OneHot",
    "OnePixel",
    "ParticleModel",
    "PartsDecoder",
    "PartsEncoder",
    "PartsLikelihood",
    "PixelDecoder",
    "PixelEncoder",
    "PosteriorModel",
    "RecurrentModel",
    "Rollout",
    "State",
    "StateSpaceModel",
    "SymlogNormal",
    "VectorModel",
    "VectorNormal",
    "elbo_loss",
    "has_posterior",
]
