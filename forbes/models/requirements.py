"""Refuse parts of a world model that do not fit together."""

from collections.abc import Mapping

from forbes.beliefs import CategoricalBelief
from forbes.errors import ForbesError
from forbes.models.base import BeliefModel
from forbes.models.elbo import KL, FreeNats
from forbes.models.likelihoods import Likelihood, Normal, VectorNormal
from forbes.models.particles import ParticleModel
from forbes.models.parts import PartsLikelihood
from forbes.models.state_space import StateSpaceModel
from forbes.shapes import Shape

__all__ = ["likelihood_for", "require_closed_form", "require_mean", "require_path", "require_same_states"]


def require_path(kl: KL, model: BeliefModel) -> None:
    """Raise a ForbesError if the path derivative is asked of a model that has none."""
    if kl != "path":
        return
    if not isinstance(model, StateSpaceModel):
        raise ForbesError(f"WorldModel: kl is path for a {type(model).__name__}, expected analytic. Leave kl out")
    if not model.posterior.reparameterised:
        name = type(model.posterior).__name__
        raise ForbesError(
            f"WorldModel: kl is path, but the draws of a {name} are not reparameterised, expected analytic or "
            "monte_carlo. Leave kl out"
        )


def require_same_states(model: BeliefModel) -> None:
    """Raise a ForbesError if prior and posterior are not over the same states, so that they have no KL."""
    if not isinstance(model, StateSpaceModel):
        return
    posterior, prior = (
        f"one-hot variables of {head.classes} classes" if isinstance(head, CategoricalBelief) else "real vectors"
        for head in (model.posterior, model.prior)
    )
    if posterior != prior:
        raise ForbesError(
            f"WorldModel: the states of the belief are {posterior}, those of the prior {prior}, expected the same. "
            "Leave prior out, or choose another"
        )


def require_closed_form(kl: KL, free_nats_per: FreeNats, model: BeliefModel) -> None:
    """Raise a ForbesError if an option is asked for that needs the KL in closed form, and the model has none."""
    if not isinstance(model, StateSpaceModel):
        return
    context = next(model.parameters()).new_zeros(1, model.posterior.context_dim)  # (1, C), on the model's device
    if (
        kl == "analytic"
        and not isinstance(model, ParticleModel)
        and model.posterior.kl(context, model.prior, context) is not None
    ):
        return
    if free_nats_per == "element":
        raise ForbesError(
            "WorldModel: free_nats_per is element, but the KL is estimated by samples, and to clip these gives another "
            "loss, expected batch. Leave free_nats_per out"
        )
    if isinstance(model.posterior, CategoricalBelief) and model.posterior.kl_weights is not None:
        raise ForbesError(
            "WorldModel: kl_balance weighs the gradients of the KL in closed form, but the KL is estimated by samples. "
            "Leave kl_balance out, or use kl: analytic with a StateSpaceModel"
        )


def likelihood_for(observation_shape: Shape, likelihood: Likelihood) -> Likelihood:
    """Return the likelihood of observations of this shape, or raise a ForbesError if it does not fit them."""
    if isinstance(likelihood, PartsLikelihood):
        return likelihood.for_shape(observation_shape)
    if isinstance(observation_shape, Mapping):
        raise ForbesError(
            f"WorldModel: the likelihood {type(likelihood).__name__} is of one array, found observations of the parts "
            f"{', '.join(observation_shape)}. Use PartsLikelihood as model.likelihood, with one for each part"
        )
    if likelihood.rank != len(observation_shape):
        others = {1: "VectorNormal or OneHot", 3: "Normal or Bernoulli"}.get(len(observation_shape), "your own")
        raise ForbesError(
            f"WorldModel: the likelihood {type(likelihood).__name__} is of observations of rank {likelihood.rank}, "
            f"found shape {(*observation_shape,)}. Choose {others} as model.likelihood"
        )
    return likelihood


def require_mean(likelihood: Likelihood) -> None:
    """Raise a ForbesError unless the decoder's output is the mean of the target, to which a center can be added."""
    parts = likelihood.parts.values() if isinstance(likelihood, PartsLikelihood) else [likelihood]
    if not all(isinstance(part, Normal | VectorNormal) for part in parts):
        raise ForbesError(
            f"WorldModel: center with the likelihood {type(likelihood).__name__}, expected Normal or VectorNormal. "
            "Leave center out"
        )
