r"""What a belief says of the future: the likelihood of a sequence's rest given its beginning.

.. math::

    \log p(o_{c+1:T} \mid o_{1:c}) \approx \log \frac1K \sum_k \prod_{t>c} p(o_t \mid h_t^k, s_t^k), \qquad
    (h_c, s_c)^k \sim \text{belief}, \quad (h_t, s_t)^k \sim \text{prior rolled on}

The mean over particles is outside the product over time and inside the logarithm, so a belief is rewarded for holding
the truth as one of several futures. Never the mean of logarithms, which rewards hedging.
"""

import torch

from forbes.data import SequenceBatch
from forbes.evaluation.bounds import Increments, LogMeanExp, frame_log_prob
from forbes.models import BeliefModel

__all__ = ["score_open_loop"]


@torch.no_grad()
def score_open_loop(model: BeliefModel, batch: SequenceBatch, number: int, context: int) -> Increments:
    """Score a batch with K futures: `open_loop`, and `open_loop_marginal` for how it degrades with the horizon.

    The sum of `open_loop` over t is log p(o_{c+1:T} | o_{1:c}); `open_loop_marginal` is log p(o_t | o_{1:c}) of each
    step on its own. Both are 0 up to c. Each draw of the belief gives as many futures as it has particles: an RSSM's
    one, from a posterior trajectory of its own, since the belief is over (h, s); that of a model without randomness is
    the only one.

    Args:
        model: in eval mode, on the batch's device.
        batch: B sequences of T steps.
        number: K.
        context: c, steps that the model sees, from 1 to T - 1.
    """
    mask = batch.mask[:, context:].double()  # (B, T - c)
    seen = model.see(batch.observation[:, :context], batch.action[:, :context])
    target = model.likelihood.target(batch.observation[:, context:]).flatten(0, 1)  # (B (T - c), *O)
    future = batch.action[:, context:].repeat(model.particles, 1, 1)  # (N B, T - c, A)
    joint, marginal = LogMeanExp(), LogMeanExp()
    for _ in range(model.draws(number)):
        features = model.imagine(model.beliefs(seen, model.particles), future).features  # (N B, T - c, F)
        of_each = features.view(model.particles, len(target), -1)  # (N, B (T - c), F)
        for log_prob in frame_log_prob(model, of_each, target).view(-1, *mask.shape):  # N times (B, T - c)
            joint.add((log_prob * mask).cumsum(1))
            marginal.add(log_prob)
    before = torch.zeros_like(batch.mask[:, :context], dtype=torch.float64)  # (B, c)
    scores = {
        "open_loop": joint.result().diff(dim=1, prepend=torch.zeros_like(mask[:, :1])),
        "open_loop_marginal": marginal.result() * mask,
    }
    return {name: torch.cat((before, values), 1) for name, values in scores.items()}  # (B, T)
