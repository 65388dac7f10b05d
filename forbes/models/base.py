r"""What training, evaluation and figures ask of a model, whatever its filter.

.. math:: h_t = \mathrm{GRU}(h_{t-1}, \mathrm{MLP}(s_{t-1}, a_{t-1})), \qquad p(o_t \mid \text{features}_t)

Every model carries a pair (h, s) along a sequence; what s is, and how it learns of o_t, is the model's own.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from forbes.beliefs import BeliefFamily
from forbes.configured import Configurable
from forbes.models.elbo import KL, ElboTerms
from forbes.models.likelihoods import Likelihood
from forbes.models.networks import MLP, Decoder, Encoder
from forbes.shapes import printed_by_shape

__all__ = ["BeliefModel", "EncodedSequence", "FrameLogProb", "ModelFamily", "Rollout", "State"]


@printed_by_shape
class State(NamedTuple):
    """What the recurrence carries."""

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
    """s_t, drawn from the prior, `(B, T, D)`."""
    log_prob: Tensor
    """log p(s_t | h_t) in nats, `(B, T)`."""

    @property
    def features(self) -> Tensor:
        """[h_t, s_t], the input of every decoder, `(B, T, H + D)`."""
        return torch.cat((self.hidden, self.state), -1)  # (B, T, H + D)


@printed_by_shape
class EncodedSequence(NamedTuple):
    """What a filter reads, encoded once for all the times it is read."""

    target: Tensor
    """o_t as `Likelihood.target` or `Likelihood.sample` gives it, `(B, T, *O)`."""
    embedding: Tensor
    """e_t, `(B, T, E)`."""
    action: Tensor
    """a_{t-1}, `(B, T, A)`."""


FrameLogProb: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""log p(o | features) in nats: features `(*, N, F)` and N targets `(N, *O)`, each scored under every leading index, to
`(*, N)`."""


class BeliefModel(Configurable, nn.Module, ABC):
    """A recurrent model that holds a belief: it filters, predicts, imagines and decodes.

    To add one whose filter differs, copy `vector.py`: every abstract method below, and nothing else.

    Args:
        encoder: o_t to e_t.
        decoder: features to the likelihood's parameters.
        likelihood: what the decoder's output means.
        input_dim: of (s, a), what moves the recurrence.
        hidden_dim: H of h.
        mlp_dim: width of the perceptron before the GRU.
        mlp_layers: layers of it.
    """

    parts: ClassVar[tuple[str, ...]] = ("reconstruction", "kl")
    """What training logs beside the bound: parts of it, or names of `ElboTerms.auxiliary`."""
    particles: int = 1
    """How many of them one draw of the belief has."""
    center: Tensor | None
    """The mean target, `(*O)`: encoder and decoder see what differs from it; None leaves both as they are."""

    def __init__(
        self,
        encoder: Encoder,
        decoder: Decoder,
        likelihood: Likelihood,
        input_dim: int,
        hidden_dim: int,
        mlp_dim: int,
        mlp_layers: int,
    ) -> None:
        super().__init__()
        self.hidden_dim = hidden_dim
        self.encoder, self.decoder, self.likelihood = encoder, decoder, likelihood
        self.transition = MLP(input_dim, mlp_dim, mlp_layers)
        self.gru = nn.GRUCell(mlp_dim, hidden_dim)
        self.register_buffer("center", None)

    @property
    @abstractmethod
    def bound_name(self) -> str:
        """Name the bound that `elbo` estimates, with its likelihood and its number of samples."""

    @abstractmethod
    def initial(self, batch: int) -> State:
        """Return (h_0, s_0), `(B, ...)`: what is carried before anything was seen."""

    @abstractmethod
    def lower_bound(self, observation: Tensor, action: Tensor, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        """Estimate the lower bound of log p(o_1:T) that the model is trained by.

        Args:
            observation: as in `SequenceBatch`, like the next two.
            action: a_{t-1}.
            mask: True where the step counts.
            kl: how the KL is differentiated, where the model has one.
        """

    @abstractmethod
    def sample_beliefs(self, encoded: EncodedSequence, samples: int) -> State:
        """Draw N of the belief over (h, s) after the last step, given all that was seen: `(N B, ...)`, sample-major."""

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
        """Roll on from `start` without observations, each row on its own trajectory.

        Args:
            start: (h, s), `(B, ...)`; `beliefs` gives several per history.
            action: a of each step, the one that leads to it, `(B, T, A)`.

        Returns:
            T steps after `start`, which itself is not among them.
        """

    def num_belief_samples(self, number: int) -> int:
        """Return how many independent draws of the belief make so many particles."""
        return number

    def encode(self, observation: Tensor, action: Tensor) -> EncodedSequence:
        """Read stored observations `(B, T, *O)` and the actions that led to them `(B, T, A)`."""
        target = self.likelihood.target(observation)
        return EncodedSequence(target, self.embed_target(target), action)

    def embed(self, observation: Tensor) -> Tensor:
        """Encode every frame: stored observations `(B, T, *O)` to e `(B, T, E)`."""
        return self.embed_target(self.likelihood.target(observation))

    def embed_target(self, target: Tensor) -> Tensor:
        """Encode every frame as `Likelihood.target` or `Likelihood.sample` gives it: `(B, T, *O)` to e `(B, T, E)`."""
        shown = target if self.center is None else target - self.center
        embedding: Tensor = self.encoder(shown.flatten(0, 1)).to(target.dtype)  # (B T, E)
        return embedding.view(*target.shape[:2], -1)  # (B, T, E)

    def decode(self, features: Tensor) -> Tensor:
        """Return the likelihood's parameters: features `(*, F)` to `(*, *O)`."""
        output: Tensor = self.decoder(features.flatten(0, -2))  # (N, *O)
        if self.center is not None:
            output = output + self.center
        return output.view(*features.shape[:-1], *output.shape[1:])  # (*, *O)

    def log_likelihood(self, features: Tensor, target: Tensor) -> Tensor:
        """Return log p(o | features) in nats: `(*, F)` and `(*, *O)`, which broadcast, to `(*)`."""
        return self.likelihood.log_prob(self.decode(features).float(), target)


ModelFamily: TypeAlias = Callable[
    [BeliefFamily, Encoder, Decoder, Likelihood, int, int, int, int, int, BeliefFamily | None], BeliefModel
]
"""Builds a model from (belief, encoder, decoder, likelihood, action_dim, state_dim, hidden_dim, mlp_dim, mlp_layers,
prior): a class of this package with its other arguments bound."""
