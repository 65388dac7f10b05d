r"""Models whose belief has a density: what the bounds, and one-step predictions with the posterior's help, are made of.

.. math:: (h_t, s_t): \quad s_t \sim q(\cdot \mid h_t, e_t), \qquad \text{prior } p(s_t \mid h_t)
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple, TypeGuard

import torch
from torch import Tensor
from torch.nn.functional import softplus

from forbes.models.base import BeliefModel, EncodedSequence, FrameLogProb, State
from forbes.shapes import printed_by_shape

__all__ = ["Filtered", "PosteriorModel", "has_posterior"]


@printed_by_shape
class Filtered(NamedTuple):
    """A trajectory of the posterior, and what the bound and further samples need; a single step has no T."""

    hidden: Tensor
    """h_t, `(B, T, H)`."""
    state: Tensor
    """s_t, drawn from the posterior, `(B, T, D)`."""
    context: Tensor
    """The posterior's context of (h_t, e_t), `(B, T, C)`."""
    log_prob: Tensor
    """log q(s_t | h_t, e_t) in nats, `(B, T)`."""

    @property
    def features(self) -> Tensor:
        """[h_t, s_t], the input of every decoder, `(B, T, H + D)`."""
        return torch.cat((self.hidden, self.state), -1)  # (B, T, H + D)

    def at(self, time: int) -> State:
        """Return (h, s) at one step, from which the filter can continue."""
        return State(self.hidden[:, time], self.state[:, time])  # (B, H), (B, D)


class PosteriorModel(BeliefModel):
    """A model that filters by a posterior with a density: an RSSM of any kind, or a `ModelAdapter` with densities."""

    @property
    def lacks(self) -> tuple[str, ...]:
        """See `BeliefModel.lacks`: nothing."""
        return ()

    @abstractmethod
    def filter(self, embedding: Tensor, action: Tensor, start: State | None = None) -> Filtered:
        """Run the posterior along a sequence.

        Args:
            embedding: e_t, `(B, T, E)`.
            action: a_{t-1}, the action that led to o_t, `(B, T, A)`.
            start: (h, s) before the first step; `initial` by default.

        Returns:
            One trajectory of (h_t, s_t) per sequence. It is causal: for the same noise, a prefix of the input gives the
            prefix of the output.
        """

    @abstractmethod
    def prepare_step(self, embedding: Tensor, action: Tensor, copies: int = 1) -> Callable[[State], Filtered]:
        """Return a step of the filter for a loop over a sequence.

        Args:
            embedding: e_t, `(B, T, E)`.
            action: a_{t-1}, the action that led to o_t, `(B, T, A)`.
            copies: N, copies of each sequence that are filtered side by side.

        Returns:
            The step, to be called at most T times: (h, s) before it to those after it, `(N B, ...)`, copy-major.
        """

    @abstractmethod
    def prior_log_prob(self, filtered: Filtered) -> Tensor:
        """Return log p(s_t | h_t) of the posterior's samples in nats, `(B, T)`."""

    @abstractmethod
    def posterior_log_prob(self, state: Tensor, filtered: Filtered) -> Tensor:
        """Return log q(s | h_t, e_t) in nats, of any s `(*, B, T, D)`: `(*, B, T)`."""

    @abstractmethod
    def sample_prior(self, filtered: Filtered) -> tuple[Tensor, Tensor]:
        """Sample s from p(s | h_t) of each step, `(B, T, D)`, and return it with its log-density in nats, `(B, T)`."""

    def predictive_log_prob(self, encoded: EncodedSequence, log_likelihood: FrameLogProb) -> Tensor:
        """See `BeliefModel.predictive_log_prob`: along one posterior trajectory."""
        filtered = self.filter(encoded.embedding, encoded.action)

        def score(features: Tensor) -> Tensor:
            log_prob = log_likelihood(features.flatten(0, 1), encoded.target.flatten(0, 1))  # (B T,)
            return log_prob.view(features.shape[:2])  # (B, T)

        return self.one_step_log_prob(filtered, score(filtered.features), score)

    def one_step_log_prob(
        self, filtered: Filtered, reconstruction: Tensor, log_likelihood: Callable[[Tensor], Tensor]
    ) -> Tensor:
        r"""Estimate log p(o_t | h_t), in nats, from a sample of the prior and the posterior's.

        .. math:: \hat p(o_t \mid h_t) = \sum_{s \in \{\tilde s_t,\, s_t\}} p(o_t \mid h_t, s)\,
                  \frac{p(s \mid h_t)}{p(s \mid h_t) + q(s \mid h_t, e_t)}, \qquad
                  \tilde s_t \sim p(\cdot \mid h_t), \quad s_t \sim q(\cdot \mid h_t, e_t)

        This is multiple importance sampling with the balance heuristic (Veach and Guibas, 1995): unbiased for every
        posterior. The prior rarely finds an o_t that leaves few states possible. The posterior finds them, and no
        weight can exceed 1, however narrow it is.

        Args:
            filtered: from `filter`, any leading shape `(*)`.
            reconstruction: log p(o_t | h_t, s_t), `(*)`.
            log_likelihood: log p(o_t | features) of features `(*, H + D)`, to `(*)`.

        Returns:
            `(*)`, in the dtype of `reconstruction`.
        """
        sample, log_prior = self.sample_prior(filtered)  # (*, D), (*)
        log_posterior = self.posterior_log_prob(sample, filtered)
        prediction = log_likelihood(torch.cat((filtered.hidden, sample), -1))
        by_prior = prediction + _log_share(log_prior, log_posterior)
        by_posterior = reconstruction + _log_share(self.prior_log_prob(filtered), filtered.log_prob)
        return torch.logaddexp(by_prior, by_posterior)


def has_posterior(model: BeliefModel) -> TypeGuard[PosteriorModel]:
    """Return whether a model has bounds, so that the methods of `PosteriorModel` can be called."""
    return isinstance(model, PosteriorModel) and "elbo" not in model.lacks


def _log_share(log_p: Tensor, log_q: Tensor) -> Tensor:
    """Return log p / (p + q)."""
    return -softplus(log_q - log_p)
