r"""The sequential Monte-Carlo bound of a sequence, FIVO-K (Maddison et al., 2017, arXiv 1705.09279).

.. math:: \mathrm{FIVO}_K = E \sum_t \log \sum_k W_{t-1}^k w_t^k

The particles are those of `forbes.models.particles`, with systematic resampling, whatever the model is trained by.
"""

from functools import partial

import torch

from forbes.data import SequenceBatch
from forbes.evaluation.bounds import Increments, frame_log_prob
from forbes.models import StateSpaceModel
from forbes.models.particles import effective_sample_size, run_particles, systematic

__all__ = ["score_particles"]


@torch.no_grad()
def score_particles(model: StateSpaceModel, batch: SequenceBatch, number: int) -> Increments:
    """Score a batch with K particles: `fivo`, and `ess`, the effective sample size before resampling, as a share of K.

    Args:
        model: in eval mode, on the batch's device.
        batch: B sequences; K B rows are held at once.
        number: K.
    """
    seen, fivo, ess = model.see(batch.observation, batch.action), [], []
    log_likelihood = partial(frame_log_prob, model)
    for step in run_particles(model, seen, number, systematic, log_likelihood, dtype=torch.float64):
        fivo.append(step.increment)  # (B,)
        ess.append(effective_sample_size(step.log_weight) / number)
    scores = {"fivo": torch.stack(fivo, 1), "ess": torch.stack(ess, 1)}  # (B, T)
    return {name: values * batch.mask for name, values in scores.items()}
