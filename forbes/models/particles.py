r"""Sequential Monte Carlo: a belief of K weighted particles of (h, s), and the model trained by its bound.

.. math::

    (h, s)_t^k \sim q \text{ from } (h, s)_{t-1}^k, \qquad
    w_t^k = \frac{p(o_t \mid h_t^k, s_t^k)\, p(s_t^k \mid h_t^k)}{q(s_t^k \mid h_t^k, e_t)} \\
    \hat p_t = \sum_k W_{t-1}^k w_t^k, \qquad W_t^k = W_{t-1}^k w_t^k / \hat p_t, \qquad
    \log p(o_{1:T}) \ge E \sum_t \log \hat p_t

The product of all :math:`\hat p_t` is an unbiased estimate of p(o_1:T), so the mean of its logarithm is a bound
(FIVO, Maddison et al., 2017, arXiv 1705.09279). Where the effective sample size falls below K / 2, particles are
resampled, h and s jointly; `torch.where` decides, so shapes never depend on values.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor

from forbes.errors import ForbesError, require_at_least, require_one_of
from forbes.frozen import frozen
from forbes.models.base import EncodedSequence, FrameLogProb, ModelParts, State
from forbes.models.elbo import KL, ElboTerms
from forbes.models.posterior import Filtered, PosteriorModel
from forbes.models.state_space import StateSpaceModel
from forbes.performance.precision import full_precision
from forbes.shapes import Observed, printed_by_shape

__all__ = ["ParticleModel", "Particles", "effective_sample_size", "run_particles", "soft", "systematic"]
__all__ += ["sample_weighted_beliefs", "systematic_resampling"]

Resampling: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Normalised log-weights `(K, B)` to ancestors `(K, B)` and the log-weights of their children `(K, B)`."""

_SOFTNESS = 0.5
"""α of soft resampling: the share of ancestors that are drawn by weight."""


@printed_by_shape
class Particles(NamedTuple):
    """The particles of one step, before they are resampled."""

    filtered: Filtered
    """(h_t, s_t) with context and density, `(K B, ...)`, particle-major."""
    log_before: Tensor
    """log W_{t-1} of those they come from, `(K, B)`; after soft resampling not normalised."""
    log_weight: Tensor
    """log W_t, normalised, `(K, B)`."""
    log_likelihood: Tensor
    """log p(o_t | h_t, s_t) in nats, `(K, B)`."""
    increment: Tensor
    """What the step adds to the bound, log p̂_t in nats, `(B,)`."""
    parts: Mapping[str, Tensor]
    """The log-likelihood of each part of an observation of several, `(K, B)` each."""


def effective_sample_size(log_weight: Tensor) -> Tensor:
    """Return 1 / Σ_k W_k² of normalised log-weights: `(K, B)` to `(B,)`, between 1 and K."""
    return torch.exp(-torch.logsumexp(2 * log_weight, 0))


def systematic_resampling(log_weight: Tensor, uniform: Tensor, number: int) -> Tensor:
    r"""Choose N ancestors: child j comes from the first particle whose cumulative weight exceeds :math:`(j + u) / N`.

    Each particle k is chosen :math:`\lfloor N W_k \rfloor` or :math:`\lceil N W_k \rceil` times, N W_k on average.

    Args:
        log_weight: normalised, `(K, B)`.
        uniform: u in [0, 1), one for each sequence, `(B,)`.
        number: N.

    Returns:
        Indices of the ancestors, `(N, B)`, int64.
    """
    cumulative = log_weight.exp().cumsum(0).T.contiguous()  # (B, K)
    places = (torch.arange(number, device=uniform.device) + uniform[:, None]) / number  # (B, N)
    chosen = torch.searchsorted(cumulative, places, right=True)  # (B, N)
    return chosen.clamp(max=len(log_weight) - 1).T  # (N, B); rounding may leave the last sum below 1


def systematic(log_weight: Tensor) -> tuple[Tensor, Tensor]:
    """Draw ancestors by weight; their children weigh the same, and nothing of the weights is left to a gradient."""
    number, uniform = len(log_weight), torch.rand_like(log_weight[0])  # (B,)
    equal = torch.full_like(log_weight, -math.log(number))
    return systematic_resampling(log_weight, uniform, number), equal


def soft(log_weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Draw ancestors by weight or evenly, and correct for it, so that gradients pass through the weights.

    .. math:: a \sim V = \alpha W + (1 - \alpha) / K, \qquad W' = W_a / (K V_a)

    PF-net and DPFRL (arXiv 1805.08975, 2002.09884) then normalise W'. Here it stays as it is, and :math:`\hat p_t`
    unbiased.
    """
    number, uniform = len(log_weight), torch.rand_like(log_weight[0])  # (B,)
    evenly = (1 - _SOFTNESS) / number
    mixed = (_SOFTNESS * log_weight.exp() + evenly).log()  # (K, B)
    ancestor = systematic_resampling(mixed, uniform, number)
    return ancestor, (log_weight - mixed).gather(0, ancestor) - math.log(number)


_RESAMPLING: Mapping[str, Resampling] = {"systematic": systematic, "soft": soft}


def run_particles(
    model: PosteriorModel,
    encoded: EncodedSequence,
    number: int,
    resampling: Resampling,
    log_likelihood: Callable[[Tensor, Tensor], tuple[Tensor, Mapping[str, Tensor]]],
    dtype: torch.dtype,
) -> Iterator[Particles]:
    """Filter a sequence with K particles and give them step by step, so that only one step need be held.

    Args:
        model: its posterior is the proposal.
        encoded: B sequences of T steps.
        number: K.
        resampling: `systematic` or `soft`.
        log_likelihood: log p(o_t | features), of features `(K, B, H + D)` and o_t `(B, *O)`, to `(K, B)`, and that of
            each part.
        dtype: of the weights.
    """
    sequences, steps = encoded.embedding.shape[:2]
    stay = torch.arange(number, device=encoded.embedding.device)[:, None].expand(-1, sequences)  # (K, B)
    log_before = torch.full(stay.shape, -math.log(number), dtype=dtype, device=stay.device)
    with full_precision(encoded.embedding):
        step = model.prepare_step(encoded.embedding, encoded.action, number)
    carried = model.initial(number * sequences)
    for t in range(steps):
        with full_precision(encoded.embedding):
            moved = step(carried)
        features = moved.features.view(*stay.shape, -1)  # (K, B, H + D)
        reconstruction, parts = log_likelihood(features, encoded.target[:, t])
        divergence = (moved.log_prob - model.prior_log_prob(moved)).view(stay.shape)  # (K, B)
        joint = log_before + reconstruction - divergence
        increment = joint.logsumexp(0)  # (B,)
        log_weight = joint - increment
        yield Particles(moved, log_before, log_weight, reconstruction, increment, parts)
        again = effective_sample_size(log_weight) < number / 2  # (B,)
        ancestor, log_child = resampling(log_weight)
        carried = _choose(moved, torch.where(again, ancestor, stay))
        log_before = torch.where(again, log_child, log_weight)


def sample_weighted_beliefs(model: PosteriorModel, encoded: EncodedSequence, number: int) -> State:
    """Sample (h, s) after the last step, `(B, ...)`, from K weighted particles; the posterior is their proposal.

    A posterior trajectory never reconsiders an earlier state. Weights and resampling do, so that this is a sample of
    the exact belief of the model as K grows, whatever its posterior is.

    Args:
        model: any model with a posterior.
        encoded: B sequences of T steps.
        number: K.
    """
    steps = run_particles(model, encoded, number, systematic, model.log_likelihood_by_part, torch.float64)
    return _draw_last(steps, 1)


def _draw_last(steps: Iterator[Particles], samples: int) -> State:
    """Draw a systematic sample of the last weighted set, `(N B, ...)`."""
    last = deque(steps, maxlen=1)[0]
    uniform = torch.rand_like(last.log_weight[0])  # (B,)
    return _choose(last.filtered, systematic_resampling(last.log_weight, uniform, samples))


def _choose(filtered: Filtered, index: Tensor) -> State:
    """Take particles `(K B, ...)` by their index within each sequence, `(N, B)`: `(N B, ...)`; h and s go together."""
    sequences = index.shape[1]
    row = (index * sequences + torch.arange(sequences, device=index.device)).flatten()  # (N B,)
    return State(filtered.hidden[row], filtered.state[row])  # (N B, ...)


class ParticleModel(StateSpaceModel):
    """An RSSM whose belief is K weighted particles, trained by their bound (DVRL, Igl et al., 2018, arXiv 1806.02426).

    With K = 1 it is the RSSM itself. DVRL resamples at every step. Here only sequences whose effective sample size is
    below K / 2 are resampled, since that adds variance. As in DVRL, the gradient leaves out the choice of ancestors.
    With `kl: path`, the gradient of each step's posterior is the doubly reparameterised one; otherwise it is plain.

    Args:
        parts: see `StateSpaceModel`.
        particles: number of particles, K.
        resampling: "systematic"; or "soft", which lets gradients pass through the weights of the resampled particles.

    Raises:
        ForbesError: when K is below 1, or `resampling` is another word.

    Example:
        >>> parts = forbes.ModelParts(
        ...     belief=forbes.GaussianBelief, encoder=forbes.MLPEncoder((3,)), decoder=forbes.MLPDecoder(20, (3,)),
        ...     likelihood=forbes.VectorNormal(), action_dim=2, state_dim=4, hidden_dim=16, mlp_dim=16, mlp_layers=1)
        >>> model = forbes.ParticleModel(parts, particles=4)
        >>> terms = model.lower_bound(torch.zeros(5, 10, 3), torch.zeros(5, 10, 2), torch.ones(5, 10, dtype=torch.bool))
        >>> terms.elbo.shape
        torch.Size([5])
    """

    def __init__(
        self, parts: ModelParts, particles: int = 8, resampling: Literal["systematic", "soft"] = "systematic"
    ) -> None:
        super().__init__(parts)
        require_at_least(1, "ParticleModel", particles=particles)
        require_one_of(_RESAMPLING, "ParticleModel", resampling=resampling)
        self.particles = particles
        self.resampling = _RESAMPLING[resampling]

    @property
    def bound_name(self) -> str:
        """See `BeliefModel.bound_name`."""
        return f"fivo[{self.likelihood.name},K={self.particles}]"

    def lower_bound(self, observation: Observed, action: Tensor, mask: Tensor, kl: KL = "analytic") -> ElboTerms:
        r"""See `BeliefModel.lower_bound`: with K particles.

        The reconstruction is the weighted mean :math:`\sum_k W_t^k \log p(o_t \mid h_t^k, s_t^k)`, the KL what it
        exceeds :math:`\log \hat p_t` by.
        """
        encoded = self.encode(observation, action)
        steps = list(self._run(encoded))
        increment = torch.stack([step.increment for step in steps], 1)  # (B, T)
        if kl == "path" and self.posterior.reparameterised:
            increment = increment + self._double_reparameterisation(steps, encoded)

        def weighted(values: Iterator[Tensor]) -> Tensor:
            means = [(step.log_weight.exp() * each).sum(0) for step, each in zip(steps, values, strict=True)]
            return torch.stack(means, 1)  # (B, T)

        reconstruction = weighted(step.log_likelihood for step in steps)
        parts = {name: weighted(step.parts[name] for step in steps) for name in steps[0].parts}
        return ElboTerms(reconstruction, reconstruction - increment, analytic_kl=None, mask=mask, parts=parts)

    def _double_reparameterisation(self, steps: Sequence[Particles], encoded: EncodedSequence) -> Tensor:
        r"""Return zeros, `(B, T)`; added to log p̂_t, they replace a noisy part of its gradient by one of equal mean.

        .. math:: E\, W_t \frac{\partial \log q(s_t \mid c)}{\partial c}
                  = E\, W_t (1 - W_t)\, \frac{\partial \log w_t}{\partial s_t} \frac{\partial s_t}{\partial c}

        The left side, where s_t is held constant, is what the gradient of log p̂_t contains; the right side replaces it
        (Tucker et al., 2019, arXiv 1810.04152). For one particle this is the `path` of an RSSM.
        """
        filtered = Filtered(
            *(torch.stack(values, 1) for values in zip(*(step.filtered for step in steps), strict=True))
        )
        weight = torch.stack([step.log_weight.exp() for step in steps], -1).detach()  # (K, B, T)
        fixed = filtered._replace(hidden=filtered.hidden.detach(), context=filtered.context.detach())  # (K B, T, ...)
        with frozen(self):  # functions of s_t alone
            log_joint = self.log_likelihood(fixed.features.unflatten(0, weight.shape[:2]), encoded.target)
            log_joint = log_joint + self.prior_log_prob(fixed).view(weight.shape)  # (K, B, T)
            log_posterior = self.posterior_log_prob(fixed.state, fixed).view(weight.shape)
        noisy = weight * filtered.log_prob.view(weight.shape)
        kept = weight * log_posterior + weight * (1 - weight) * (log_joint - log_posterior)
        replaced = (noisy - kept).sum(0)  # (B, T)
        return replaced - replaced.detach()

    def sample_beliefs(self, encoded: EncodedSequence, samples: int) -> State:
        """See `BeliefModel.sample_beliefs`: a systematic sample of one weighted set, with repetitions."""
        return _draw_last(self._run(encoded), samples)

    def predictive_log_prob(self, encoded: EncodedSequence, log_likelihood: FrameLogProb) -> Tensor:
        """See `BeliefModel.predictive_log_prob`: the weighted mean over one set of particles."""

        def step_log_prob(step: Particles, target: Tensor) -> Tensor:
            def score(features: Tensor) -> Tensor:
                return log_likelihood(features.view(*step.log_before.shape, -1), target).flatten()  # (K B,)

            each = self.one_step_log_prob(step.filtered, score(step.filtered.features), score)  # (K B,)
            return (step.log_before.log_softmax(0) + each.view(step.log_before.shape)).logsumexp(0)  # (B,)

        steps = zip(self._run(encoded), encoded.target.unbind(1), strict=True)
        return torch.stack([step_log_prob(step, target) for step, target in steps], 1)  # (B, T)

    def num_belief_samples(self, number: int) -> int:
        """See `BeliefModel.num_belief_samples`: a draw is a whole set."""
        if number % self.particles:
            raise ForbesError(
                f"ParticleModel: {number} particles or futures, expected whole sets of {self.particles}, "
                f"what a belief has. Choose a multiple of {self.particles}"
            )
        return number // self.particles

    def _run(self, encoded: EncodedSequence) -> Iterator[Particles]:
        return run_particles(
            self, encoded, self.particles, self.resampling, self.log_likelihood_by_part, dtype=encoded.embedding.dtype
        )
