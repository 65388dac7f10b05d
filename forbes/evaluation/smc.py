r"""The sequential Monte-Carlo bound of a sequence, FIVO-K (Maddison et al., 2017, arXiv 1705.09279).

.. math::

    \mathrm{FIVO}_K = E \sum_t \log \sum_k W_{t-1}^k w_t^k, \qquad
    w_t^k = \frac{p(o_t \mid h_t^k, s_t^k)\, p(s_t^k \mid h_t^k)}{q(s_t^k \mid h_t^k, e_t)}

with normalised weights W. Where the effective sample size :math:`1 / \sum_k (W_t^k)^2` falls below K/2 the particles
are drawn anew, h and s jointly, by systematic resampling, and weigh the same again.
"""

import math

import torch
from torch import Tensor

from forbes.data import SequenceBatch
from forbes.evaluation.bounds import Increments, frame_log_prob
from forbes.models import State, StateSpaceModel

__all__ = ["effective_sample_size", "score_particles", "systematic_resampling"]


def effective_sample_size(log_weight: Tensor) -> Tensor:
    """Give 1 / Σ_k W_k² of normalised log-weights: `(K, B)` to `(B,)`, between 1 and K."""
    return torch.exp(-torch.logsumexp(2 * log_weight, 0))


def systematic_resampling(log_weight: Tensor, uniform: Tensor) -> Tensor:
    r"""Choose ancestors: particle j is the first whose cumulative weight exceeds :math:`(j + u) / K`.

    Each particle k is chosen :math:`\lfloor K W_k \rfloor` or :math:`\lceil K W_k \rceil` times, K W_k on average.

    Args:
        log_weight: normalised, `(K, B)`.
        uniform: u in [0, 1), one for each sequence, `(B,)`.

    Returns:
        Indices of the ancestors, `(K, B)`, int64.
    """
    number = len(log_weight)
    cumulative = log_weight.exp().cumsum(0).T.contiguous()  # (B, K)
    places = (torch.arange(number, device=uniform.device) + uniform[:, None]) / number  # (B, K)
    chosen = torch.searchsorted(cumulative, places, right=True)  # (B, K)
    return chosen.clamp(max=number - 1).T  # (K, B); rounding may leave the last sum below 1


@torch.no_grad()
def score_particles(model: StateSpaceModel, batch: SequenceBatch, number: int) -> Increments:
    """Score a batch with K particles: `fivo`, and `ess`, the effective sample size before resampling, as a share of K.

    Args:
        model: in eval mode, on the batch's device.
        batch: B sequences; K B rows are held at once.
        number: K.
    """
    sequences, steps = batch.mask.shape
    embedding = model.embed(batch.observation)  # (B, T, E)
    target = model.likelihood.target(batch.observation)  # (B, T, *O)
    start = model.initial(number * sequences)
    equal = torch.full((number, sequences), -math.log(number), dtype=torch.float64, device=batch.mask.device)
    log_weight, fivo, ess = equal, [], []
    for t in range(steps):
        now = slice(t, t + 1)
        embedded, action = (values[:, now].repeat(number, 1, 1) for values in (embedding, batch.action))  # (K B, 1, *)
        filtered = model.filter(embedded, action, start)
        features = filtered.features.view(number, sequences, -1)  # (K, B, H + D)
        kl = (filtered.log_prob - model.prior_log_prob(filtered)).double().view(number, sequences)
        log_weight = log_weight + frame_log_prob(model, features, target[:, t]) - kl  # (K, B)
        fivo.append(torch.logsumexp(log_weight, 0))  # (B,)
        log_weight = log_weight - fivo[-1]
        ess.append(effective_sample_size(log_weight) / number)
        again = ess[-1] < 0.5  # (B,)
        ancestor = systematic_resampling(log_weight, torch.rand(sequences, device=again.device, dtype=torch.float64))
        stay = torch.arange(number, device=again.device)[:, None].expand_as(ancestor)
        start = _choose(filtered.at(0), torch.where(again, ancestor, stay))
        log_weight = torch.where(again, equal, log_weight)
    scores = {"fivo": torch.stack(fivo, 1), "ess": torch.stack(ess, 1)}  # (B, T)
    return {name: values * batch.mask for name, values in scores.items()}


def _choose(particles: State, index: Tensor) -> State:
    """Take particles, `(K B, …)`, by the index of each within its sequence, `(K, B)`; h and s go together."""
    row = index * index.shape[1] + torch.arange(index.shape[1], device=index.device)  # (K, B)
    return State(*(values[row.flatten()] for values in particles))  # (K B, …)
