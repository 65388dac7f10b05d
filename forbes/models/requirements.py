"""Refuse parts of a world model that do not fit together."""

from forbes.errors import ForbesError
from forbes.models.base import BeliefModel
from forbes.models.elbo import KL
from forbes.models.likelihoods import Likelihood, Normal, VectorNormal
from forbes.models.state_space import StateSpaceModel

__all__ = ["require_mean", "require_path", "require_rank"]


def require_path(kl: KL, model: BeliefModel) -> None:
    """Raise a ForbesError if the path derivative is asked of a model that has none."""
    if kl != "path":
        return
    if type(model) is not StateSpaceModel:
        raise ForbesError(f"WorldModel: kl is path for a {type(model).__name__}, expected analytic. Leave kl out")
    if not model.posterior.reparameterised:
        name = type(model.posterior).__name__
        raise ForbesError(
            f"WorldModel: kl is path, but the draws of a {name} are not reparameterised, expected analytic or "
            "monte_carlo. Leave kl out"
        )


def require_rank(likelihood: Likelihood, observation_shape: tuple[int, ...]) -> None:
    """Raise a ForbesError if a likelihood would sum over dimensions that are not those of an observation."""
    if likelihood.rank != len(observation_shape):
        others = {1: "VectorNormal or OneHot", 3: "Normal or Bernoulli"}.get(len(observation_shape), "your own")
        raise ForbesError(
            f"WorldModel: the likelihood {type(likelihood).__name__} is of observations of rank {likelihood.rank}, "
            f"found shape {(*observation_shape,)}. Choose {others} as model.likelihood"
        )


def require_mean(likelihood: Likelihood) -> None:
    """Raise a ForbesError unless the decoder's output is the mean of the target, to which a center can be added."""
    if not isinstance(likelihood, Normal | VectorNormal):
        raise ForbesError(
            f"WorldModel: center with the likelihood {type(likelihood).__name__}, expected Normal or VectorNormal. "
            "Leave center out"
        )
