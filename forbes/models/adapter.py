r"""A world model that was trained elsewhere, as a `BeliefModel`: what is needed to score it, and nothing else.

.. math::

    h_t = f(h_{t-1}, s_{t-1}, a_{t-1}), \qquad \text{prior } p(s_t \mid h_t), \qquad
    \text{posterior } q(s_t \mid h_t, e_t), \qquad p(o_t \mid h_t, s_t)

A model without densities has draws of the belief and a roll-out instead. Its prequential score is then

.. math:: \sum_t \log \frac1K \sum_k p(o_t \mid \tilde h_t^k, \tilde s_t^k), \qquad
          (h_{t-1}, s_{t-1})^k \sim \text{belief}(o_{1:t-1}), \quad
          (\tilde h_t, \tilde s_t)^k \sim \text{predict}((h_{t-1}, s_{t-1})^k, a_{t-1})
"""

from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import Distribution

from forbes.errors import ForbesError
from forbes.models.base import BOUNDS, EncodedSequence, FrameLogProb, Rollout, State
from forbes.models.elbo import KL, ElboTerms
from forbes.models.posterior import Filtered, PosteriorModel
from forbes.shapes import Observed

__all__ = ["ModelAdapter"]


class ModelAdapter(PosteriorModel):
    r"""Any torch world model, to be scored by `forbes evaluate --model my_adapter:Model`.

    Load the network in `__init__` and assign it to an attribute. Set `likelihood` to what the decoder's output means,
    e.g. `forbes.Bernoulli()`; it makes the density normalised, and in the units of the data. A state is a pair of
    tensors `(hidden, state)`, `(N, H)` and `(N, D)`, with all that the next step and the decoder need; H or D may be 0.
    The action of a step is the one that led to it, 0 at the first. Implement `initial`, `decode_state`, and

    - `observe` and `predict`: one draw of the state after one more step, with and without its observation. This gives
      the PLL and the open-loop score; or
    - `advance`, `prior` and `posterior`: h and the two distributions of s. `observe` and `predict` follow from them.
      There are ELBO, IWAE and FIVO too, and a PLL that needs fewer particles.

    Scores that a model lacks are n/a. `embed_target` may be overridden with the encoder, which then runs once for a
    sequence, not in each step of each sample. Of a model without steps, e.g. a transformer, override `beliefs`. An own
    `Likelihood` may raise NotImplementedError in `sample` and `mean`; then PSNR and SSIM are n/a, completions refused.

    Without densities, the PLL is :math:`\log \frac1K \sum_k p(o_t \mid \tilde h_t^k, \tilde s_t^k)` with K independent
    draws of the belief after t - 1 observations, each predicted one step. The mean is an unbiased estimate of
    :math:`p(o_t \mid o_{1:t-1})`, so the logarithm is a lower bound in expectation (Jensen), and rises with K.

    Example:
        >>> class Model(forbes.ModelAdapter):  # the next observation is near the last one
        ...     likelihood = forbes.VectorNormal(std=1.0)
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.net = torch.nn.Linear(3, 3)
        ...     def initial(self, batch):
        ...         return forbes.State(torch.zeros(batch, 3), torch.zeros(batch, 0))
        ...     def observe(self, before, action, embedding):
        ...         return forbes.State(embedding, before.state)
        ...     def predict(self, before, action):
        ...         return before
        ...     def decode_state(self, state):
        ...         return self.net(state.hidden)
        >>> model = Model()
        >>> encoded = model.encode(torch.zeros(5, 10, 3), torch.zeros(5, 10, 2))
        >>> model.sample_beliefs(encoded, 4).hidden.shape
        torch.Size([20, 3])
    """

    def __init__(self) -> None:
        super().__init__()
        kind, base = type(self), ModelAdapter
        densities = kind.advance is not base.advance and kind.prior is not base.prior
        self.has_densities = densities and kind.posterior is not base.posterior
        self.has_steps = kind.beliefs is base.beliefs
        draws = kind.observe is not base.observe or not self.has_steps
        for method, given in (("predict", kind.predict is not base.predict), ("observe", draws)):
            if not (given or self.has_densities):
                raise ForbesError(
                    f"{kind.__name__}: has no {method}. Implement observe and predict, or advance, prior and posterior"
                )

    @abstractmethod
    def initial(self, batch: int) -> State:
        """Return the state before the first observation, `(B, ...)`."""

    @abstractmethod
    def decode_state(self, state: State) -> Tensor:
        """Return the parameters of the likelihood, `(N, *O)`."""

    def advance(self, before: State, action: Tensor) -> Tensor:
        """Return h_t, `(N, H)`, of the state before it, `(N, ...)`, and a_{t-1}, `(N, A)`."""
        raise NotImplementedError

    def prior(self, hidden: Tensor) -> Distribution:
        """Return p(s_t | h_t) of N rows; its event may have any shape of D numbers."""
        raise NotImplementedError

    def posterior(self, hidden: Tensor, embedding: Tensor) -> Distribution:
        """Return q(s_t | h_t, e_t) of N rows."""
        raise NotImplementedError

    def observe(self, before: State, action: Tensor, embedding: Tensor) -> State:
        """Sample the belief after one more action and observation.

        Args:
            before: a sample of the belief after o_{t-1}, `(N, ...)`.
            action: a_{t-1}, `(N, A)`.
            embedding: e_t as `embed_target` gives it, `(N, E)`.
        """
        hidden = self.advance(before, action)  # (N, H)
        return State(hidden, self.posterior(hidden, embedding).sample().flatten(1))  # (N, D)

    def predict(self, before: State, action: Tensor) -> State:
        """Sample the state after one more action, without an observation."""
        hidden = self.advance(before, action)  # (N, H)
        return State(hidden, self.prior(hidden).sample().flatten(1))  # (N, D)

    def beliefs(self, embedding: Tensor, action: Tensor) -> State:
        """Sample one trajectory of the belief, causally: e `(B, T, E)` and a_{t-1} `(B, T, A)` to `(B, T, ...)`."""
        state, states = self.initial(len(action)), []
        for taken, given in zip(action.unbind(1), embedding.unbind(1), strict=True):
            state = self.observe(state, taken, given)
            states.append(state)
        return _stacked(states)

    def embed_target(self, target: Tensor) -> Tensor:
        """Encode every frame, as `Likelihood.target` gives it: `(B, T, *O)` to `(B, T, E)`. Default: flat."""
        return target.flatten(2)

    @property
    def lacks(self) -> tuple[str, ...]:
        """See `BeliefModel.lacks`: bounds without densities, FIVO without steps."""
        if not self.has_densities:
            return BOUNDS
        return () if self.has_steps else ("fivo", "ess")

    @property
    def bound_name(self) -> str:
        """See `BeliefModel.bound_name`."""
        return f"elbo[{self.likelihood.name},S=1]"

    def lower_bound(self, observation: Observed, action: Tensor, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        """Refuse: an adapter is only scored."""
        raise ForbesError(
            f"{type(self).__name__}: an adapter is scored, not trained. Train the model with its own code"
        )

    def filter(self, embedding: Tensor, action: Tensor, start: State | None = None) -> Filtered:
        """See `PosteriorModel.filter`. The context of a step is e_t.

        Raises:
            ForbesError: for another start than `initial`.
        """
        if start is not None:
            raise ForbesError(
                f"{type(self).__name__}: the filter of an adapter starts at `initial`, found a start. Call `observe`"
            )
        drawn = self.beliefs(embedding, action)
        return Filtered(*drawn, embedding, self._log_posterior(drawn, embedding))

    def prepare_step(self, embedding: Tensor, action: Tensor, copies: int = 1) -> Callable[[State], Filtered]:
        """See `PosteriorModel.prepare_step`."""
        steps = zip(action.unbind(1), embedding.unbind(1), strict=True)

        def step(before: State) -> Filtered:
            taken, given = (values.repeat(copies, 1) for values in next(steps))  # (N B, ...)
            drawn = self.observe(before, taken, given)
            return Filtered(*drawn, given, self._log_posterior(drawn, given))

        return step

    def sample_beliefs(self, encoded: EncodedSequence, samples: int) -> State:
        """See `BeliefModel.sample_beliefs`: every sample has its own trajectory."""
        drawn = self.beliefs(encoded.embedding.repeat(samples, 1, 1), encoded.action.repeat(samples, 1, 1))
        return State(drawn.hidden[:, -1], drawn.state[:, -1])  # (N B, ...)

    def predictive_log_prob(self, encoded: EncodedSequence, log_likelihood: FrameLogProb) -> Tensor:
        """See `BeliefModel.predictive_log_prob`: of one prediction from each step of one trajectory of the belief."""
        if self.has_densities:
            return super().predictive_log_prob(encoded, log_likelihood)
        first = self.initial(len(encoded.action))
        drawn = self.beliefs(encoded.embedding[:, :-1], encoded.action[:, :-1])  # (B, T - 1, ...)
        before = (torch.cat((one[:, None], more), 1).flatten(0, 1) for one, more in zip(first, drawn, strict=True))
        predicted = self.predict(State(*before), encoded.action.flatten(0, 1))  # (B T, ...)
        log_prob = log_likelihood(torch.cat(predicted, -1), encoded.target.flatten(0, 1))  # (B T,)
        return log_prob.view(encoded.action.shape[:2])  # (B, T)

    def imagine(self, start: State, action: Tensor) -> Rollout:
        """See `BeliefModel.imagine`; without the density of the states."""
        state, states = start, []
        for taken in action.unbind(1):
            state = self.predict(state, taken)
            states.append(state)
        rolled = _stacked(states)
        return Rollout(*rolled, torch.full(action.shape[:2], torch.nan, device=action.device))

    def prior_log_prob(self, filtered: Filtered) -> Tensor:
        """See `PosteriorModel.prior_log_prob`."""
        return _log_prob(self.prior(filtered.hidden.flatten(0, -2)), filtered.state)

    def posterior_log_prob(self, state: Tensor, filtered: Filtered) -> Tensor:
        """See `PosteriorModel.posterior_log_prob`."""
        shape = state.shape[:-1]
        hidden, context = (values.expand(*shape, -1) for values in (filtered.hidden, filtered.context))
        return self._log_posterior(State(hidden, state), context)

    def sample_prior(self, filtered: Filtered) -> tuple[Tensor, Tensor]:
        """See `PosteriorModel.sample_prior`."""
        prior = self.prior(filtered.hidden.flatten(0, -2))
        state = prior.sample().reshape(filtered.state.shape)  # (*, D)
        return state, _log_prob(prior, state)

    def decode(self, features: Tensor) -> Tensor:
        """See `BeliefModel.decode`."""
        width = self.initial(1).hidden.shape[-1]
        rows = features.flatten(0, -2)  # (N, H + D)
        output = self.decode_state(State(rows[:, :width], rows[:, width:]))  # (N, *O)
        return output.view(*features.shape[:-1], *output.shape[1:])  # (*, *O)

    def _log_posterior(self, drawn: State, embedding: Tensor) -> Tensor:
        """Return log q(s | h, e): states `(*, ...)` and `(*, E)` to `(*)`."""
        posterior = self.posterior(drawn.hidden.flatten(0, -2), embedding.flatten(0, -2))
        return _log_prob(posterior, drawn.state)


def _stacked(states: list[State]) -> State:
    """Stack steps `(B, ...)` over time, `(B, T, ...)`."""
    return State(*(torch.stack(values, 1) for values in zip(*states, strict=True)))


def _log_prob(distribution: Distribution, state: Tensor) -> Tensor:
    """Return the log-density of `(*, D)` under a distribution of as many rows, whose event may have another shape."""
    shape = distribution.batch_shape + distribution.event_shape
    log_prob: Tensor = distribution.log_prob(state.reshape(shape))  # (N,)
    return log_prob.view(state.shape[:-1])  # (*)
