r"""How far a belief is from a Gaussian: whether its family is used, or a Gaussian would have done.

.. math:: \mathrm{KL}\left(q(\cdot \mid c) \,\|\, N(\mu_q, \Sigma_q)\right)
          = E_q \log q + \tfrac12 \log\det(2 \pi e\, \Sigma_q)

with the belief's own mean and covariance: of all Gaussians the nearest. Near 0, a Gaussian of full covariance says the
same, however flexible the family.
"""

import math

import torch
from torch import Tensor

from forbes.beliefs import BeliefHead, CategoricalBelief
from forbes.data.episodes import Episode
from forbes.evaluation.followed import followed
from forbes.seeding import derive_seed
from forbes.training.acting import ActingModel

__all__ = ["non_gaussianity", "prior_and_posterior"]

_DRAWS = 1024
_STEPS = 64
"""Of an episode, evenly spread."""


def non_gaussianity(head: BeliefHead, context: Tensor) -> Tensor:
    r"""Estimate the KL of beliefs from the Gaussians of their moments, by draws; without bias where they are Gaussian.

    With the covariance S of n draws, whose :math:`\log\det` is too small by what is known of Wishart's distribution:

    .. math:: \overline{\log q} + \tfrac12 \left(D \log 2\pi + D + \log\det S
              - \sum_{i=1}^D \psi\left(\tfrac{n-i}2\right) - D \log \tfrac2{n-1}\right)

    Args:
        head: of a continuous state.
        context: c, `(*, C)`.

    Returns:
        Nats, float64 `(*)`.
    """
    state, log_prob = head.rsample(context, (_DRAWS,))  # (n, *, D), (n, *)
    centred = (state - state.mean(0)).double()
    covariance = torch.einsum("n...i,n...j->...ij", centred, centred) / (_DRAWS - 1)  # (*, D, D)
    dim = head.state_dim
    degrees = (_DRAWS - torch.arange(1, dim + 1, dtype=torch.float64, device=context.device)) / 2  # (D,)
    shift = degrees.digamma().sum() + dim * math.log(2 / (_DRAWS - 1))
    entropy_of_gaussian = (dim * math.log(2 * math.pi) + dim + covariance.logdet() - shift) / 2  # (*)
    kl: Tensor = log_prob.double().mean(0) + entropy_of_gaussian
    return kl


def prior_and_posterior(agent: ActingModel, episode: Episode, seed: int) -> Tensor | None:
    """Average it over the steps of an episode, for prior and posterior, float64 `(2,)`; None where s is not continuous.

    Args:
        agent: in eval mode.
        episode: what its belief is shown.
        seed: of the draws.
    """
    model = agent.model
    heads = model.prior, model.posterior
    if any(isinstance(head, CategoricalBelief) for head in heads):
        return None
    with followed(agent, episode, 1, derive_seed(seed, "gaussianity", 0)) as (filtered, _):
        every = -(-filtered.hidden.shape[1] // _STEPS)
        contexts = model.prior_context(filtered.hidden[0, ::every]), filtered.context[0, ::every]  # 2 x (T / every, C)
        return torch.stack([non_gaussianity(*each).mean().cpu() for each in zip(heads, contexts, strict=True)])  # (2,)
