"""The evidence lower bound of a recurrent belief model and the loss that trains it (paper, equation of §3.1)."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

from torch import Tensor

from forbes.distributed import masked_sums
from forbes.shapes import printed_by_shape

__all__ = ["KL", "ElboTerms", "FreeNats", "elbo_loss"]

FreeNats = Literal["batch", "element"]
KL = Literal["analytic", "monte_carlo", "path"]
"""How the KL is differentiated; its expected gradient is the same.

- analytic: the closed form where prior and posterior have one, else as path; for weighted particles as monte_carlo.
- path: log q(s) - log p(s) at the posterior's sample, with log q a function of s alone (`path_log_prob`), for weighted
  particles doubly reparameterised; as monte_carlo where samples are not reparameterised.
- monte_carlo: the same, with log q a function of its parameters too.
"""


@printed_by_shape
class ElboTerms(NamedTuple):
    r"""The parts of the bound, per step, in nats.

    .. math:: J = \sum_t \log p(o_t \mid h_t, s_t) - \left(\log q_K(s_t) - \log p_K(s_t)\right), \quad s_t \sim q_K
    """

    reconstruction: Tensor
    """log p(o_t | features), `(B, T)`."""
    kl: Tensor
    """log q(s_t) - log p(s_t) at the posterior's own sample, `(B, T)`; reported for every family."""
    analytic_kl: Tensor | None
    """The closed form of its expectation given (h_t, e_t), `(B, T)`, if it was requested and the family has one."""
    mask: Tensor
    """True where the step counts, `(B, T)`."""
    auxiliary: Mapping[str, Tensor] = {}
    """Further losses by name, scalars in nats per step. They are part of the loss only, never of a reported bound."""
    parts: Mapping[str, Tensor] = {}
    """The reconstruction of each part of an observation of several, whose sum it is, `(B, T)` each."""

    @property
    def elbo(self) -> Tensor:
        """J per sequence without padding, shape `(B,)`."""
        return ((self.reconstruction - self.kl) * self.mask).sum(1)

    def mean_over_steps(self, values: Tensor) -> Tensor:
        """Average `(B, T)` over the steps that count."""
        total, count = masked_sums(values, self.mask)
        return total / count


def elbo_loss(
    terms: ElboTerms, free_nats: float = 0.0, free_nats_per: FreeNats = "batch", kl_weight: float | Tensor = 1.0
) -> Tensor:
    r"""Negative bound per step, with free nats.

    .. math:: L = \beta \max(\overline{KL_t},\, n) - \overline{\log p(o_t)}, \quad\text{or}\quad
              L = \beta\,\overline{\max(KL_t, n)} - \overline{\log p(o_t)}

    The bar is the mean over batch and time without padding. The KL is the closed form where the terms have one. Free
    nats and the weight are part of the loss only, never of a reported bound. Auxiliary losses are added.

    Args:
        terms: the parts of the bound.
        free_nats: n, in nats per step.
        free_nats_per: "batch" averages first (Dreamer, ours), "element" clips each step (PlaNet), which is meant for
            a KL in closed form: of samples, E max(KL_t, n) is not max(E KL_t, n).
        kl_weight: :math:`\beta`, 1 except during a warm-up.

    Returns:
        L in nats per step, a scalar.
    """
    kl = terms.kl if terms.analytic_kl is None else terms.analytic_kl
    if free_nats_per == "element":
        divergence = terms.mean_over_steps(kl.clamp(min=free_nats))
    else:
        divergence = terms.mean_over_steps(kl).clamp(min=free_nats) if free_nats > 0 else terms.mean_over_steps(kl)
    loss = kl_weight * divergence - terms.mean_over_steps(terms.reconstruction)
    return sum(terms.auxiliary.values(), loss)
