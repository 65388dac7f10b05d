r"""The recurrent state-space model: filter a sequence, imagine its future, decode both (paper §3.1).

.. math::

    y_t = \mathrm{MLP}(s_{t-1}, a_{t-1}), \quad h_t = \mathrm{GRU}(h_{t-1}, y_t), \quad (h_0, s_0) = 0 \\
    \text{prior } p(s_t \mid h_t), \qquad \text{posterior } q(s_t \mid h_t, e_t), \quad e_t = \mathrm{encoder}(o_t)

`StateSpaceModel.step` is this definition for one step. Only the posterior's sample feeds the recurrence, so the time
loop holds the transition, the GRU and the posterior. The encoder runs before the loop, the prior and the decoder after
it, once over (B·T).
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from forbes.beliefs import BeliefHead
from forbes.errors import require_at_least
from forbes.models.base import EncodedSequence, ModelParts, RecurrentModel, Rollout, State
from forbes.models.elbo import KL, ElboTerms
from forbes.models.networks import MLP
from forbes.models.posterior import Filtered, PosteriorModel
from forbes.performance.precision import full_precision
from forbes.performance.recurrence import prepare_gru
from forbes.performance.time_loop import TimeLoop
from forbes.shapes import Observed

__all__ = ["StateSpaceModel"]


class StateSpaceModel(PosteriorModel, RecurrentModel):
    """RSSM with any belief family: Gaussian gives PlaNet's and Dreamer's, flow gives FORBES.

    Args:
        parts: what it is made of; `state_dim` is at least 1.

    Example:
        >>> model = forbes.StateSpaceModel(forbes.ModelParts(
        ...     belief=forbes.GaussianBelief, encoder=forbes.MLPEncoder((3,)), decoder=forbes.MLPDecoder(20, (3,)),
        ...     likelihood=forbes.VectorNormal(), action_dim=2, state_dim=4, hidden_dim=16, mlp_dim=16, mlp_layers=1))
        >>> terms = model.lower_bound(torch.zeros(5, 10, 3), torch.zeros(5, 10, 2), torch.ones(5, 10, dtype=torch.bool))
        >>> terms.elbo.shape
        torch.Size([5])
    """

    def __init__(self, parts: ModelParts) -> None:
        require_at_least(1, type(self).__name__, state_dim=parts.state_dim)
        super().__init__(parts, parts.state_dim + parts.action_dim)
        self.action_dim, self.state_dim = parts.action_dim, parts.state_dim
        embedding_dim, context_dim, layers = parts.encoder.embedding_dim, parts.mlp_dim, parts.mlp_layers
        self.prior_context = MLP(parts.hidden_dim, context_dim, layers)
        self.posterior_context = MLP(parts.hidden_dim + embedding_dim, context_dim, layers)
        self.prior: BeliefHead = (parts.prior or parts.belief)(parts.state_dim, context_dim)
        self.posterior: BeliefHead = parts.belief(parts.state_dim, context_dim)

    @property
    def bound_name(self) -> str:
        """See `BeliefModel.bound_name`."""
        return f"elbo[{self.likelihood.name},S=1]"

    def initial(self, batch: int) -> State:
        """Return (h_0, s_0) = 0."""
        weight = self.gru.weight_hh
        return State(weight.new_zeros(batch, self.hidden_dim), weight.new_zeros(batch, self.state_dim))

    def step(self, before: State, embedding: Tensor, action: Tensor) -> Filtered:
        r"""Filter one step: move (h, s) by the action that was taken, then correct s by what was observed.

        .. math:: h_t = \mathrm{GRU}(h_{t-1}, \mathrm{MLP}(s_{t-1}, a_{t-1})), \quad
                  c_t = \mathrm{MLP}(h_t, e_t), \quad s_t \sim q(s_t \mid c_t)

        Args:
            before: (h_{t-1}, s_{t-1}), `(B, ...)`.
            embedding: e_t, `(B, E)`.
            action: a_{t-1}, `(B, A)`.
        """
        hidden = self.gru(self.transition(torch.cat((before.state, action), -1)), before.hidden)  # (B, H)
        context = self.posterior_context(torch.cat((hidden, embedding), -1))  # (B, C)
        state, log_prob = self.posterior.rsample(context)  # (B, D), (B,)
        return Filtered(hidden, state, context, log_prob)

    def prepare_step(self, embedding: Tensor, action: Tensor, copies: int = 1) -> Callable[[State], Filtered]:
        """See `PosteriorModel.prepare_step`: the numbers of `step`, faster (`forbes.performance.time_loop`).

        What does not depend on (h, s) is hoisted out of the loop: the terms of e_t and a_{t-1} in the first layers (one
        product over all steps each), the weights that a flow merges, and the gradients of the weights.
        """
        loop = TimeLoop(steps=embedding.shape[1], batch=copies * len(embedding))
        transition = self.transition.prepare(action, loop)
        gru = prepare_gru(self.gru, loop)
        posterior_context = self.posterior_context.prepare(embedding, loop)
        sample = self.posterior.sampler(loop)

        def step(before: State) -> Filtered:
            hidden = gru(transition(before.state), before.hidden)  # (N B, H)
            context = posterior_context(hidden)  # (N B, C)
            state, log_prob = sample(context)  # (N B, D), (N B,)
            return Filtered(hidden, state, context, log_prob)

        return step

    def filter(self, embedding: Tensor, action: Tensor, start: State | None = None) -> Filtered:
        """See `PosteriorModel.filter`: from (h_0, s_0) = 0 by default."""
        state = start or self.initial(len(embedding))
        step: Callable[[State], Filtered]
        steps: list[Filtered] = []
        with full_precision(embedding):
            if embedding.shape[1] == 1:  # as when an agent acts: there is nothing to hoist
                step = partial(self.step, embedding=embedding[:, 0], action=action[:, 0])
            else:
                step = self.prepare_step(embedding, action)
            for _ in range(embedding.shape[1]):
                steps.append(step(state))
                state = State(steps[-1].hidden, steps[-1].state)
        return Filtered(*(torch.stack(values, 1) for values in zip(*steps, strict=True)))  # (B, T, ...)

    def prior_log_prob(self, filtered: Filtered) -> Tensor:
        """See `PosteriorModel.prior_log_prob`."""
        with full_precision(filtered.state):
            return self.prior.log_prob(filtered.state, self.prior_context(filtered.hidden))

    def imagine(self, start: State, action: Tensor) -> Rollout:
        """See `BeliefModel.imagine`: a rollout of the prior."""
        state, states, log_probs = start, [], []
        with full_precision(start.state):
            step = self.prepare_imagination(*action.shape[:2])
            for taken in action.unbind(1):
                state, log_prob = step(state, taken)
                states.append(state)
                log_probs.append(log_prob)
        hidden, drawn = (torch.stack(values, 1) for values in zip(*states, strict=True))  # (B, T, H), (B, T, D)
        return Rollout(hidden, drawn, torch.stack(log_probs, 1))

    def prepare_imagination(self, batch: int, steps: int) -> Callable[[State, Tensor], tuple[State, Tensor]]:
        """Prepare the prior for a loop of T steps over B trajectories, within `full_precision`.

        Returns:
            One step: (h, s), `(B, …)`, and the action taken there, `(B, A)`, to the next (h, s) and its log p(s | h) in
            nats, `(B,)`.
        """
        sample = self.prior.sampler(TimeLoop(steps, batch))

        def step(before: State, action: Tensor) -> tuple[State, Tensor]:
            hidden = self.gru(self.transition(torch.cat((before.state, action), -1)), before.hidden)  # (B, H)
            state, log_prob = sample(self.prior_context(hidden))
            return State(hidden, state), log_prob

        return step

    def sample_beliefs(self, encoded: EncodedSequence, samples: int) -> State:
        """See `BeliefModel.sample_beliefs`: every sample has its own posterior trajectory, since h is random too."""
        embedding = encoded.embedding.repeat(samples, 1, 1)  # (N B, T, E)
        action = encoded.action.repeat(samples, 1, 1)  # (N B, T, A)
        return self.filter(embedding, action).at(-1)  # (N B, ...)

    def posterior_log_prob(self, state: Tensor, filtered: Filtered) -> Tensor:
        """See `PosteriorModel.posterior_log_prob`."""
        with full_precision(filtered.state):
            return self.posterior.log_prob(state, filtered.context)

    def sample_prior(self, filtered: Filtered) -> tuple[Tensor, Tensor]:
        """See `PosteriorModel.sample_prior`."""
        with full_precision(filtered.state):
            return self.prior.rsample(self.prior_context(filtered.hidden))

    def lower_bound(self, observation: Observed, action: Tensor, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        """See `BeliefModel.lower_bound`: with one posterior trajectory per sequence."""
        encoded = self.encode(observation, action)
        return self.bound(self.filter(encoded.embedding, action), encoded, mask, kl)

    def bound(self, filtered: Filtered, encoded: EncodedSequence, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        """Estimate the bound with a posterior trajectory, which `filter` has drawn for this sequence."""
        reconstruction, parts = self.log_likelihood_by_part(filtered.features, encoded.target)
        with full_precision(filtered.state):
            prior_context = self.prior_context(filtered.hidden)  # (B, T, C)
            analytic = self.posterior.kl(filtered.context, self.prior, prior_context) if kl == "analytic" else None
            log_posterior = filtered.log_prob
            if analytic is None and kl != "monte_carlo" and self.posterior.reparameterised:
                log_posterior = self.posterior.path_log_prob(filtered.state, filtered.context)  # (B, T)
            sampled = log_posterior - self.prior.log_prob(filtered.state, prior_context)  # (B, T)
        return ElboTerms(reconstruction, sampled, analytic, mask, parts=parts)
