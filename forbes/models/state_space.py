r"""The recurrent state-space model: filter a sequence, imagine its future, decode both (DESIGN §5, paper §3.1).

.. math::

    y_t = \mathrm{MLP}(s_{t-1}, a_{t-1}), \quad h_t = \mathrm{GRU}(h_{t-1}, y_t), \quad (h_0, s_0) = 0 \\
    \text{prior } p(s_t \mid h_t), \qquad \text{posterior } q(s_t \mid h_t, e_t), \quad e_t = \mathrm{encoder}(o_t)

Only the posterior's sample feeds the recurrence. So the time loop holds the transition, the GRU and the posterior;
the encoder runs before it, the prior and the decoder after it, once over (B·T).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from forbes.beliefs import BeliefFamily, BeliefHead
from forbes.deferred import Affine, Loop
from forbes.models.elbo import ElboTerms
from forbes.models.likelihoods import Likelihood
from forbes.models.networks import Decoder, Encoder, bind_gru, perceptron

__all__ = ["Filtered", "Rollout", "State", "StateSpaceModel"]


class State(NamedTuple):
    """What the recurrence carries."""

    hidden: Tensor
    """h, `(*, H)`."""
    state: Tensor
    """s, `(*, D)`."""


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


class Filtered(NamedTuple):
    """A trajectory of the posterior, with what the bound and further samples need."""

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
        """Give the state at one step, to go on from."""
        return State(self.hidden[:, time], self.state[:, time])  # (B, H), (B, D)


class StateSpaceModel(nn.Module):
    """RSSM with any belief family: Gaussian gives PlaNet's and Dreamer's, flow gives FORBES.

    Args:
        belief: builds the prior's and the posterior's head from (state_dim, context_dim).
        encoder: o_t to e_t.
        decoder: features to the likelihood's parameters; its input has `hidden_dim + state_dim` dimensions.
        likelihood: what the decoder's output means.
        action_dim: A, may be 0.
        state_dim: D of s.
        hidden_dim: H of h.
        mlp_dim: width of every perceptron, and C of the belief's contexts.
        mlp_layers: layers of every perceptron.
        prior: builds the prior's instead, where it is of another family.
    """

    def __init__(
        self,
        belief: BeliefFamily,
        encoder: Encoder,
        decoder: Decoder,
        likelihood: Likelihood,
        action_dim: int,
        state_dim: int,
        hidden_dim: int,
        mlp_dim: int,
        mlp_layers: int,
        prior: BeliefFamily | None = None,
    ) -> None:
        super().__init__()
        self.action_dim, self.state_dim, self.hidden_dim = action_dim, state_dim, hidden_dim
        self.encoder, self.decoder, self.likelihood = encoder, decoder, likelihood
        self.transition = perceptron(state_dim + action_dim, mlp_dim, mlp_layers)
        self.gru = nn.GRUCell(mlp_dim, hidden_dim)
        self.prior_context = perceptron(hidden_dim, mlp_dim, mlp_layers)
        self.posterior_context = perceptron(hidden_dim + encoder.embedding_dim, mlp_dim, mlp_layers)
        self.prior: BeliefHead = (prior or belief)(state_dim, mlp_dim)
        self.posterior: BeliefHead = belief(state_dim, mlp_dim)

    def initial(self, batch: int) -> State:
        """Give (h_0, s_0) = 0."""
        weight = self.gru.weight_hh
        return State(weight.new_zeros(batch, self.hidden_dim), weight.new_zeros(batch, self.state_dim))

    def embed(self, observation: Tensor) -> Tensor:
        """Encode every frame: stored observations `(B, T, *O)` to e `(B, T, E)`."""
        return self.encode(self.likelihood.target(observation))

    def encode(self, target: Tensor) -> Tensor:
        """Encode every frame as `Likelihood.target` or `Likelihood.sample` gives it: `(B, T, *O)` to e `(B, T, E)`."""
        embedding: Tensor = self.encoder(target.flatten(0, 1))  # (B T, E)
        return embedding.view(*target.shape[:2], -1)  # (B, T, E)

    def filter(self, embedding: Tensor, action: Tensor, start: State | None = None) -> Filtered:
        """Run the posterior along a sequence.

        Args:
            embedding: e_t, `(B, T, E)`.
            action: a_{t-1}, the action that led to o_t, `(B, T, A)`.
            start: where to go on from; (h_0, s_0) = 0 by default.

        Returns:
            One trajectory of (h_t, s_t) per sequence. A prefix of the input gives the prefix of the output (for
            the same noise): nothing looks ahead.
        """
        batch, time = embedding.shape[:2]
        hidden, state = start or self.initial(batch)
        loop = Loop(time, batch)
        transition = self._bind(self.transition, action, loop)
        posterior_context = self._bind(self.posterior_context, embedding, loop)
        gru = bind_gru(self.gru, loop)
        sample = self.posterior.sampler(loop)

        steps: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for _ in range(time):
            hidden = gru(transition(state), hidden)
            context = posterior_context(hidden)
            state, log_prob = sample(context)
            steps.append((hidden, state, context, log_prob))
        return Filtered(*(torch.stack(values, 1) for values in zip(*steps, strict=True)))  # (B, T, ...)

    def prior_log_prob(self, filtered: Filtered) -> Tensor:
        """Give log p(s_t | h_t) of the posterior's samples in nats, `(B, T)`."""
        return self.prior.log_prob(filtered.state, self.prior_context(filtered.hidden))

    def imagine(self, start: State, action: Tensor) -> Rollout:
        """Roll the prior on from `start`, each row on its own trajectory.

        Args:
            start: (h, s), `(B, ...)`; `beliefs` gives several per history.
            action: a of each step, the one that leads to it, `(B, T, A)`.

        Returns:
            T steps after `start`, which itself is not among them.
        """
        given = iter(action.unbind(1))
        return self.roll(start, lambda _: next(given), action.shape[1])

    def roll(self, start: State, policy: Callable[[Tensor], Tensor], steps: int) -> Rollout:
        """Roll the prior on from `start`, each row on its own trajectory and by its own actions.

        Args:
            start: (h, s), `(B, ...)`.
            policy: the action in a state, from its features: `(B, H + D)` to `(B, A)`.
            steps: T; the policy acts in `start` and in all steps but the last.

        Returns:
            T steps after `start`, which itself is not among them.
        """
        hidden, state = start
        sample = self.prior.sampler(Loop(steps, len(state)))
        made: list[tuple[Tensor, Tensor, Tensor]] = []
        for _ in range(steps):
            action = policy(torch.cat((hidden, state), -1))
            hidden = self.gru(self.transition(torch.cat((state, action), -1)), hidden)
            state, log_prob = sample(self.prior_context(hidden))
            made.append((hidden, state, log_prob))
        return Rollout(*(torch.stack(values, 1) for values in zip(*made, strict=True)))  # (B, T, ...)

    def beliefs(self, filtered: Filtered, time: int, samples: int) -> State:
        """Draw N samples of each belief q(s_t | h_t, e_t) at one step: `(N B, ...)`, sample-major."""
        state, _ = self.posterior.rsample(filtered.context[:, time], (samples,))  # (N, B, D)
        hidden = filtered.hidden[:, time].expand(samples, -1, -1)  # (N, B, H)
        return State(hidden.flatten(0, 1), state.flatten(0, 1))  # (N B, H), (N B, D)

    def decode(self, features: Tensor) -> Tensor:
        """Give the likelihood's parameters: features `(*, H + D)` to `(*, *O)`."""
        output: Tensor = self.decoder(features.flatten(0, -2))  # (N, *O)
        return output.view(*features.shape[:-1], *output.shape[1:])  # (*, *O)

    def elbo(self, observation: Tensor, action: Tensor, mask: Tensor) -> ElboTerms:
        """Estimate the bound with one posterior trajectory per sequence; arguments as in `SequenceBatch`."""
        return self.bound(self.filter(self.embed(observation), action), observation, mask)

    def bound(self, filtered: Filtered, observation: Tensor, mask: Tensor) -> ElboTerms:
        """Estimate the bound with the posterior trajectory of `filter`."""
        prior_context = self.prior_context(filtered.hidden)  # (B, T, C)
        log_likelihood = self.likelihood.log_prob(
            self.decode(filtered.features).float(), self.likelihood.target(observation)
        )
        return ElboTerms(
            reconstruction=log_likelihood,
            kl=filtered.log_prob - self.prior.log_prob(filtered.state, prior_context),
            analytic_kl=self.posterior.kl(filtered.context, self.prior, prior_context),
            mask=mask,
        )

    @staticmethod
    def _bind(network: nn.Sequential, known: Tensor, loop: Loop) -> Affine:
        """Bind a perceptron of [x, known] to a loop over x; the share of what is known is one matmul over all steps.

        Args:
            network: a `perceptron`.
            known: the inputs that do not depend on the recurrence, `(B, T, K)`.
            loop: to bind it to.
        """
        first, *others = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
        cut = first.in_features - known.shape[-1]
        of_loop, of_known = first.weight[:, :cut], first.weight[:, cut:]  # (M, cut), (M, K)
        layers = [loop.affine(of_loop, linear(known.transpose(0, 1), of_known, first.bias))]  # share (T, B, M)
        layers += [loop.affine(layer.weight, layer.bias) for layer in others]

        def run(x: Tensor) -> Tensor:
            for layer in layers:
                x = layer(x).relu()
            return x

        return run
