r"""A belief without a distribution: h_t itself, which predicts the next observation (SimCore, DRQN).

.. math::

    h_t = \mathrm{GRU}(h_{t-1}, \mathrm{MLP}(e_{t-1}, a_{t-1})), \quad (h_0, e_0) = (0, \bar e), \qquad
    \log p(o_{1:T}) = \sum_t \log p(o_t \mid h_t)

Nothing is sampled, so the likelihood is exact, by the chain rule, and no bound is needed. In imagination, the learned
embedding :math:`\bar e` of "nothing seen" replaces missing observations: the simulator of Gregor et al., 2019,
arXiv 1906.09237. One-step predictions train it at the first step of a sequence only, hence overshooting.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from forbes.distributed import masked_sums
from forbes.errors import ForbesError, require_at_least
from forbes.models.base import EncodedSequence, FrameLogProb, ModelParts, RecurrentModel, Rollout, State
from forbes.models.elbo import KL, ElboTerms
from forbes.performance.precision import full_precision
from forbes.performance.recurrence import prepare_gru
from forbes.performance.time_loop import TimeLoop
from forbes.shapes import Observed

__all__ = ["VectorModel"]


class VectorModel(RecurrentModel):
    """A deterministic recurrent model; the pair it carries is (h_t, e_t), what it believed and what it then saw.

    Args:
        parts: what it is made of; `state_dim` is 0, since it has no stochastic state, and the belief is not used. The
            decoder's input has `hidden_dim` dimensions.
        overshoot: steps that are imagined from one random step of each sequence in training.

    Raises:
        ForbesError: when `state_dim` is not 0, or `overshoot` below 1.

    Example:
        >>> parts = forbes.ModelParts(
        ...     belief=forbes.GaussianBelief, encoder=forbes.MLPEncoder((3,)), decoder=forbes.MLPDecoder(16, (3,)),
        ...     likelihood=forbes.VectorNormal(), action_dim=2, state_dim=0, hidden_dim=16, mlp_dim=16, mlp_layers=1)
        >>> model = forbes.VectorModel(parts)
        >>> terms = model.lower_bound(torch.zeros(5, 10, 3), torch.zeros(5, 10, 2), torch.ones(5, 10, dtype=torch.bool))
        >>> terms.elbo.shape
        torch.Size([5])
    """

    logged_terms: ClassVar[tuple[str, ...]] = ("overshoot",)

    def __init__(self, parts: ModelParts, overshoot: int = 15) -> None:
        if parts.state_dim != 0:
            raise ForbesError(f"VectorModel: state_dim is {parts.state_dim}, expected 0, it has no stochastic state")
        require_at_least(1, "VectorModel", overshoot=overshoot)
        super().__init__(parts, parts.encoder.embedding_dim + parts.action_dim)
        self.overshoot = overshoot
        self.nothing = nn.Parameter(torch.zeros(parts.encoder.embedding_dim))

    @property
    def bound_name(self) -> str:
        """See `BeliefModel.bound_name`: it is the likelihood itself."""
        return f"log_p[{self.likelihood.name}]"

    def initial(self, batch: int) -> State:
        """Return h_0 = 0, with nothing seen."""
        return State(self.nothing.new_zeros(batch, self.hidden_dim), self.nothing.expand(batch, -1))

    def filter(self, embedding: Tensor, action: Tensor, start: State | None = None) -> Tensor:
        """Read a sequence.

        Args:
            embedding: e_t, `(B, T, E)`.
            action: a_{t-1}, the action that led to o_t, `(B, T, A)`.
            start: (h, e) to go on from; `initial` by default.

        Returns:
            h_t, which has seen o_{t-1} and a_{t-1}, but not o_t, `(B, T, H)`.
        """
        hidden, before = start or self.initial(len(embedding))
        return self._run(hidden, torch.cat((before[:, None], embedding[:, :-1]), 1), action)

    def imagine(self, start: State, action: Tensor) -> Rollout:
        """See `BeliefModel.imagine`: one future, without randomness, in which nothing more is seen; s has D = 0."""
        hidden, before = start
        nothing = self.nothing.expand(*action.shape[:2], -1)[:, 1:]  # (B, T - 1, E)
        rolled = self._run(hidden, torch.cat((before[:, None], nothing), 1), action)
        return Rollout(rolled, rolled[..., :0], rolled.new_zeros(rolled.shape[:2]))

    def sample_beliefs(self, encoded: EncodedSequence, samples: int) -> State:
        """See `BeliefModel.sample_beliefs`: N times the same, since it is certain."""
        hidden = self.filter(encoded.embedding, encoded.action)
        return State(hidden[:, -1].repeat(samples, 1), encoded.embedding[:, -1].repeat(samples, 1))  # (N B, ...)

    def predictive_log_prob(self, encoded: EncodedSequence, log_likelihood: FrameLogProb) -> Tensor:
        """See `BeliefModel.predictive_log_prob`: it is exact."""
        hidden = self.filter(encoded.embedding, encoded.action)
        return log_likelihood(hidden.flatten(0, 1), encoded.target.flatten(0, 1)).view(hidden.shape[:2])  # (B, T)

    def num_belief_samples(self, number: int) -> int:
        """See `BeliefModel.num_belief_samples`: one is as good as many."""
        return 1

    def lower_bound(self, observation: Observed, action: Tensor, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        """Return log p(o_t | o_<t) as the reconstruction, a KL of 0, and the loss of the overshooting."""
        encoded = self.encode(observation, action)
        hidden = self.filter(encoded.embedding, action)
        log_likelihood, parts = self.log_likelihood_by_part(hidden, encoded.target)  # (B, T)
        auxiliary = {"overshoot": self._overshoot(hidden, encoded, mask)}
        return ElboTerms(log_likelihood, torch.zeros_like(log_likelihood), None, mask, auxiliary, parts)

    def _run(self, hidden: Tensor, embedding: Tensor, action: Tensor) -> Tensor:
        """Return h after each (e, a), `(B, T, H)`: all inputs are known, so the loop holds the GRU only."""
        steps: list[Tensor] = []
        with full_precision(embedding):
            moves = self.transition(torch.cat((embedding, action), -1))  # (B, T, M)
            gru = prepare_gru(self.gru, TimeLoop(moves.shape[1], len(moves)))
            for move in moves.unbind(1):
                hidden = gru(move, hidden)
                steps.append(hidden)
        return torch.stack(steps, 1)  # (B, T, H)

    def _overshoot(self, hidden: Tensor, encoded: EncodedSequence, mask: Tensor) -> Tensor:
        r"""Return the loss of one roll-out in each sequence, from a step u among its own, in nats per step.

        .. math:: -\frac1L \sum_{j=1}^{L} \log p(o_{u+j} \mid h_u, a_{u:u+j-1}), \qquad u \sim U\{1, \dots, T - 1\}

        What would lie behind the end of a sequence does not count; index and shapes are the device's own affair.
        """
        batch, time = mask.shape
        row = torch.arange(batch, device=mask.device)
        start = (torch.rand(batch, device=mask.device) * (mask.sum(1) - 1)).long()  # (B,), u counted from 0
        index = start[:, None] + torch.arange(1, self.overshoot + 1, device=mask.device)  # (B, L)
        rows, inside = row[:, None], index.clamp(max=time - 1)
        counts = mask[rows, inside] & (index < time)  # (B, L)
        begin = State(hidden[row, start], self.nothing.expand(batch, -1))
        features = self.imagine(begin, encoded.action[rows, inside]).features  # (B, L, H)
        log_likelihood = self.log_likelihood(features, encoded.target[rows, inside])
        total, count = masked_sums(log_likelihood, counts)
        return -total / count.clamp(min=1)
