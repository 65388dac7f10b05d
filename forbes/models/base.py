r"""The interface of a belief model, which training, evaluation and figures use.

.. math:: h_t = \mathrm{GRU}(h_{t-1}, \mathrm{MLP}(s_{t-1}, a_{t-1})), \qquad p(o_t \mid \text{features}_t)

Every model carries a pair (h, s) along a sequence. Models differ in what s is, and in how it is inferred from o_t.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from forbes.beliefs import BeliefFamily
from forbes.configured import Configurable
from forbes.models.elbo import KL, ElboTerms
from forbes.models.likelihoods import Likelihood, sum_of_parts
from forbes.models.networks import MLP, Decoder, Encoder
from forbes.shapes import Observed, printed_by_shape

__all__ = ["BOUNDS", "BeliefModel", "EncodedSequence", "FrameLogProb", "ModelFamily", "ModelParts", "RecurrentModel"]
__all__ += ["Rollout", "State"]

BOUNDS = ("elbo", "reconstruction", "kl", "iwae", "fivo", "ess")
"""Scores that need the density of a posterior."""


@printed_by_shape
class State(NamedTuple):
    """The state of the recurrence.

    Example:
        >>> forbes.State(hidden=torch.zeros(5, 200), state=torch.zeros(5, 8))
        State(hidden=float32 (5, 200), state=float32 (5, 8))
    """

    hidden: Tensor
    """h, `(*, H)`."""
    state: Tensor
    """s, `(*, D)`."""


@printed_by_shape
class Rollout(NamedTuple):
    """A trajectory of the prior."""

    hidden: Tensor
    """h_t, `(B, T, H)`."""
    state: Tensor
    """s_t, sampled from the prior, `(B, T, D)`."""
    log_prob: Tensor
    """log p(s_t | h_t) in nats, `(B, T)`; NaN from a `ModelAdapter`."""

    @property
    def features(self) -> Tensor:
        """[h_t, s_t], the input of every decoder, `(B, T, H + D)`."""
        return torch.cat((self.hidden, self.state), -1)  # (B, T, H + D)


@printed_by_shape
class EncodedSequence(NamedTuple):
    """The input of a filter, encoded once for several runs of it."""

    target: Tensor
    """o_t as `Likelihood.target` or `Likelihood.sample` gives it, `(B, T, *O)`."""
    embedding: Tensor
    """e_t, `(B, T, E)`."""
    action: Tensor
    """a_{t-1}, `(B, T, A)`."""


FrameLogProb: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""log p(o | features) in nats: features `(*, N, F)` and N targets `(N, *O)`, each scored under every leading index, to
`(*, N)`."""


class ModelParts(NamedTuple):
    """What a belief model is made of. `WorldModel` collects it from its arguments.

    Example:
        >>> parts = forbes.ModelParts(
        ...     belief=forbes.GaussianBelief,
        ...     encoder=forbes.MLPEncoder((3,)),
        ...     decoder=forbes.MLPDecoder(20, (3,)),  # hidden_dim + state_dim inputs
        ...     likelihood=forbes.VectorNormal(),
        ...     action_dim=2,
        ...     state_dim=4,
        ...     hidden_dim=16,
        ...     mlp_dim=16,
        ...     mlp_layers=1,
        ... )
        >>> forbes.StateSpaceModel(parts).bound_name
        'elbo[normal(1),S=1]'
    """

    belief: BeliefFamily
    """Builds the head of the posterior, and that of the prior, from (state_dim, context_dim)."""
    encoder: Encoder
    """o_t to e_t."""
    decoder: Decoder
    """Features to the likelihood's parameters. Its input has `hidden_dim + state_dim` dimensions."""
    likelihood: Likelihood
    """What the decoder's output means."""
    action_dim: int
    """A, may be 0."""
    state_dim: int
    """D of s; 0 for a model without a stochastic state."""
    hidden_dim: int
    """H of h."""
    mlp_dim: int
    """Width of every MLP, and C of the belief's contexts."""
    mlp_layers: int
    """Layers of every MLP."""
    prior: BeliefFamily | None = None
    """Builds the head of the prior, where its family is another than `belief`."""


class BeliefModel(Configurable, nn.Module, ABC):
    """A model that holds a belief: it filters, predicts, imagines and decodes.

    To add a model whose filter differs, copy `vector.py`. A subclass implements, in the order in which they are called:

    - `bound_name`: the name of its training bound, by which the bound is logged.
    - `lower_bound`: the bound on log p(o_1:T) of a batch, with its parts; training and validation.
    - `initial`: (h_0, s_0), what the recurrence carries before the first observation.
    - `sample_beliefs`: samples of the belief after the last observation; every forecast starts from them.
    - `imagine`: a trajectory from such a sample, given actions and no observations.
    - `predictive_log_prob`: an estimate of log p(o_t | o_1:t-1) of every step; scores.

    It may override `num_belief_samples`, `lacks` and `logged_terms`. Everything else is shared. `RecurrentModel` has
    the networks of the models that are trained here; `ModelAdapter` is for a model that was trained elsewhere.
    """

    logged_terms: ClassVar[tuple[str, ...]] = ("reconstruction", "kl")
    """What training logs in addition to the bound: its parts, or names of `ElboTerms.auxiliary`."""
    particles: int = 1
    """Particles per sample of the belief."""
    likelihood: Likelihood
    """What the output of `decode` means."""

    @property
    @abstractmethod
    def bound_name(self) -> str:
        """Name the bound that `lower_bound` estimates, with its likelihood and its number of samples."""

    @abstractmethod
    def initial(self, batch: int) -> State:
        """Return (h_0, s_0), `(B, ...)`: the state before the first observation."""

    @abstractmethod
    def lower_bound(self, observation: Observed, action: Tensor, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        """Estimate the lower bound on log p(o_1:T) that trains the model.

        Args:
            observation: o_t as stored, `(B, T, *O)`, or its parts by name.
            action: a_{t-1}, `(B, T, A)`.
            mask: True where the step is no padding, `(B, T)`.
            kl: how the KL is differentiated, where the model has one.
        """

    @abstractmethod
    def sample_beliefs(self, encoded: EncodedSequence, samples: int) -> State:
        """Sample (h, s) after the last step given all observations, N times each: `(N B, ...)`, sample-major."""

    @abstractmethod
    def predictive_log_prob(self, encoded: EncodedSequence, log_likelihood: FrameLogProb) -> Tensor:
        """Estimate log p(o_t | o_<t) of every step from one sample of the belief after t - 1 steps, in nats, `(B, T)`.

        The exponential is unbiased, so that of several samples it is averaged. Step t depends on nothing after o_t.

        Args:
            encoded: B sequences of T steps.
            log_likelihood: how frames are scored; evaluation has its own, in float64.
        """

    @abstractmethod
    def imagine(self, start: State, action: Tensor) -> Rollout:
        """Continue from `start` without observations, each row on its own trajectory.

        Args:
            start: (h, s), `(B, ...)`, e.g. from `sample_beliefs`.
            action: the action that leads to each step, `(B, T, A)`.

        Returns:
            T steps after `start`, without `start` itself.
        """

    @abstractmethod
    def embed_target(self, target: Tensor) -> Tensor:
        """Encode every frame as `Likelihood.target` or `Likelihood.sample` gives it: `(B, T, *O)` to e `(B, T, E)`."""

    @abstractmethod
    def decode(self, features: Tensor) -> Tensor:
        """Return the likelihood's parameters: features `(*, F)` to `(*, *O)`."""

    @property
    def lacks(self) -> tuple[str, ...]:
        """Return the scores that the model does not have: without the density of a posterior, the bounds."""
        return BOUNDS

    def num_belief_samples(self, number: int) -> int:
        """Return how many independent samples of the belief have `number` particles together."""
        return number

    def encode(self, observation: Observed, action: Tensor) -> EncodedSequence:
        """Encode stored observations `(B, T, *O)` and the actions that led to them `(B, T, A)`."""
        target = self._target(observation)
        return EncodedSequence(target, self.embed_target(target), action)

    def embed(self, observation: Observed) -> Tensor:
        """Encode every frame: stored observations `(B, T, *O)` to e `(B, T, E)`."""
        return self.embed_target(self._target(observation))

    def _target(self, observation: Observed) -> Tensor:
        return self.likelihood.target(observation)

    def log_likelihood(self, features: Tensor, target: Tensor) -> Tensor:
        """Return log p(o | features) in nats: `(*, F)` and `(*, *O)`, which broadcast, to `(*)`."""
        return self.log_likelihood_by_part(features, target)[0]

    def log_likelihood_by_part(self, features: Tensor, target: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return log p(o | features) as `log_likelihood`, and that of each part, where an observation has several."""
        output = self.decode(features)
        output = output.to(torch.promote_types(output.dtype, torch.float32))  # in mixed precision it is bfloat16
        if parts := self.likelihood.log_prob_by_part(output, target):
            return sum_of_parts(parts), parts
        return self.likelihood.log_prob(output, target), {}


class RecurrentModel(BeliefModel):
    """The networks of a model that is trained here: encoder, transition, GRU and decoder.

    Args:
        parts: what it is made of.
        input_dim: dimensions of the input of the transition, before the GRU.
    """

    center: Tensor | None
    """The mean target, `(*O)`. Encoder and decoder then work on the difference to it; None leaves both as they are."""

    def __init__(self, parts: ModelParts, input_dim: int) -> None:
        super().__init__()
        self.hidden_dim = parts.hidden_dim
        self.encoder, self.decoder, self.likelihood = parts.encoder, parts.decoder, parts.likelihood
        self.transition = MLP(input_dim, parts.mlp_dim, parts.mlp_layers)
        self.gru = nn.GRUCell(parts.mlp_dim, parts.hidden_dim)
        self.register_buffer("center", None)

    def embed_target(self, target: Tensor) -> Tensor:
        """See `BeliefModel.embed_target`."""
        shown = target if self.center is None else target - self.center
        embedding: Tensor = self.encoder(shown.flatten(0, 1)).to(target.dtype)  # (B T, E)
        return embedding.view(*target.shape[:2], -1)  # (B, T, E)

    def _target(self, observation: Observed) -> Tensor:
        return self.likelihood.target(observation).to(self.gru.weight_hh.dtype)

    def decode(self, features: Tensor) -> Tensor:
        """See `BeliefModel.decode`."""
        output: Tensor = self.decoder(features.flatten(0, -2))  # (N, *O)
        if self.center is not None:
            output = output + self.center
        return output.view(*features.shape[:-1], *output.shape[1:])  # (*, *O)


ModelFamily: TypeAlias = Callable[[ModelParts], RecurrentModel]
"""Builds a model from its parts: a class of this package with its other arguments bound."""
