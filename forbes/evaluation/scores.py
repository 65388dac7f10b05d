r"""The scores of a model on sequences, by one convention.

Observation log-likelihood only, fully normalised, in nats; no free nats; the Monte-Carlo KL for every family; padding
does not count; logarithms and sums of probabilities in float64. With
:math:`w_t = p(o_t \mid h_t, s_t)\, p(s_t \mid h_t) / q(s_t \mid h_t, e_t)` along a trajectory of the posterior,

.. math::

    \mathrm{ELBO} &= E_q \sum_t \log w_t \;\le\;
    \mathrm{IWAE}_K = E \log \frac1K \sum_k \prod_t w_t^k \;\le\; \log p(o_{1:T}) \\
    \mathrm{PLL} &= \sum_t \log \frac1K \sum_k \hat p(o_t \mid h_t^k), \qquad
    E\, \hat p(o_t \mid h_t) = \int p(o_t \mid h_t, s)\, p(s \mid h_t)\, ds \\
    \mathrm{FIVO}_K &= E \sum_t \log \sum_k W_{t-1}^k w_t^k \;\le\; \log p(o_{1:T}) \\
    \mathrm{open\ loop} &= \log \frac1K \sum_k \prod_{t>c} p(o_t \mid h_t^k, s_t^k), \qquad
    (h_c, s_c)^k \sim \text{belief}, \quad (h_t, s_t)^k \sim \text{prior}

- IWAE (Burda et al., 2016, arXiv 1509.00519): the product over time is inside the mean over particles.
- The PLL, a prequential log-likelihood, scores the filtering belief: its particles are drawn from the belief after
  t - 1 observations (h_t follows from it) and see o_t only in their score, so it is a proper score of the belief, and
  its K-sample form a lower bound of itself (Jensen). The posterior helps to estimate the integral over s_t, without
  bias (`StateSpaceModel.one_step_log_prob`). A model that draws weighted sets of particles has their weights in the
  mean, one without randomness has K = 1.
- FIVO (Maddison et al., 2017, arXiv 1705.09279) resamples, with the particles of `forbes.models.particles` and
  systematic resampling, whatever the model is trained by.
- Open loop: the mean over particles is outside the product over time and inside the logarithm, so a belief is rewarded
  for holding the truth as one of several futures. Never the mean of logarithms, which rewards hedging.
"""

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.data import SequenceBatch
from forbes.models import BeliefModel, StateSpaceModel
from forbes.models.particles import effective_sample_size, run_particles, systematic

__all__ = ["Increments", "LogMeanExp", "Trajectory", "frame_log_prob", "score_open_loop", "score_particles"]
__all__ += ["score_predictions", "score_trajectories", "trajectories"]

Increments = dict[str, Tensor]
"""Scores by name, `(B, T)` each in nats, float64: what each step adds; the sum over t is the sequence's score."""

_FRAMES = 1000
"""Decoded at a time: the memory stays bounded, and a digit's pixels in the processor's cache (a third less time)."""


class Trajectory(NamedTuple):
    """One sample of the posterior along every sequence of a batch, in nats, float64."""

    reconstruction: Tensor
    """log p(o_t | h_t, s_t), `(B, T)`."""
    kl: Tensor
    """log q(s_t) - log p(s_t), `(B, T)`."""
    prediction: Tensor | None
    """An estimate of log p(o_t | h_t) (`StateSpaceModel.one_step_log_prob`), `(B, T)`; None where it is not wanted."""


class LogMeanExp:
    r"""A running :math:`\log \frac1K \sum_k e^{x_k}`: the memory does not grow with K."""

    def __init__(self) -> None:
        self.number = 0
        self.total = torch.tensor(-math.inf, dtype=torch.float64)

    def add(self, value: Tensor) -> None:
        """Take one more x_k, any shape, the same each time."""
        self.number += 1
        self.total = torch.logaddexp(self.total.to(value.device), value)

    def result(self) -> Tensor:
        """Return the log-mean-exp of what was added."""
        return self.total - math.log(self.number)


def frame_log_prob(model: BeliefModel, features: Tensor, target: Tensor) -> Tensor:
    """Return log p(o | features) in nats, float64, a few frames at a time.

    Args:
        model: decodes the features.
        features: `(*, N, F)`.
        target: the frames, as `Likelihood.target` gives them, `(N, *O)`; each is scored under every leading index.

    Returns:
        `(*, N)`.
    """
    size = max(1, _FRAMES // math.prod(features.shape[:-2]))
    parts = [
        model.log_likelihood(some, true).double()
        for some, true in zip(features.split(size, -2), target.split(size), strict=True)
    ]
    return torch.cat(parts, -1)  # (*, N)


def trajectories(model: StateSpaceModel, batch: SequenceBatch, number: int, predict: bool) -> Iterator[Trajectory]:
    """Draw trajectories one after the other, so that the memory is that of one; the encoder runs once.

    Args:
        model: in eval mode, on the batch's device.
        batch: B sequences.
        number: of trajectories.
        predict: whether to draw the one-step predictions too.
    """
    # Once: coarse pixels have noise, the same for both networks.
    encoded = model.encode(batch.observation, batch.action)
    target = encoded.target.flatten(0, 1)  # (B T, *O)

    def log_prob(features: Tensor) -> Tensor:
        return frame_log_prob(model, features.flatten(0, 1), target).view(batch.mask.shape)  # (B, T)

    for _ in range(number):
        filtered = model.filter(encoded.embedding, encoded.action)
        kl = filtered.log_prob - model.prior_log_prob(filtered)
        reconstruction = log_prob(filtered.features)
        prediction = model.one_step_log_prob(filtered, reconstruction, log_prob) if predict else None
        yield Trajectory(reconstruction, kl.double(), prediction)


@torch.no_grad()
def score_trajectories(model: StateSpaceModel, batch: SequenceBatch, number: int, predict: bool) -> Increments:
    """Score a batch with K trajectories: `elbo`, `reconstruction`, `kl`, `iwae`, and `pll` where `predict` is set.

    `iwae` is the bound of the first t steps less that of the first t - 1, so its sum is the bound of all.
    """
    mask = batch.mask.double()
    reconstruction, kl = torch.zeros_like(mask), torch.zeros_like(mask)
    weight, prediction = LogMeanExp(), LogMeanExp()
    for trajectory in trajectories(model, batch, number, predict):
        reconstruction += trajectory.reconstruction / number
        kl += trajectory.kl / number
        weight.add(((trajectory.reconstruction - trajectory.kl) * mask).cumsum(1))
        if trajectory.prediction is not None:
            prediction.add(trajectory.prediction)
    scores = {
        "elbo": reconstruction - kl,
        "reconstruction": reconstruction,
        "kl": kl,
        "iwae": weight.result().diff(dim=1, prepend=torch.zeros_like(mask[:, :1])),
    }
    if predict:
        scores["pll"] = prediction.result()
    return {name: values * mask for name, values in scores.items()}


@torch.no_grad()
def score_predictions(model: BeliefModel, batch: SequenceBatch, number: int) -> Increments:
    """Score a batch with K particles: `pll`, and `iwae` where the model has a posterior."""
    if isinstance(model, StateSpaceModel) and model.particles == 1:
        return score_trajectories(model, batch, number, predict=True)  # its trajectories serve both
    encoded, prediction = model.encode(batch.observation, batch.action), LogMeanExp()
    for _ in range(model.num_belief_samples(number)):
        prediction.add(model.predictive_log_prob(encoded, partial(frame_log_prob, model)))
    scores = {"pll": prediction.result() * batch.mask}
    if isinstance(model, StateSpaceModel):
        scores |= score_trajectories(model, batch, number, predict=False)
    return scores


@torch.no_grad()
def score_particles(model: StateSpaceModel, batch: SequenceBatch, number: int) -> Increments:
    """Score a batch with K particles: `fivo`, and `ess`, the effective sample size before resampling, as a share of K.

    Args:
        model: in eval mode, on the batch's device.
        batch: B sequences; K B rows are held at once.
        number: K.
    """
    encoded, fivo, ess = model.encode(batch.observation, batch.action), [], []
    log_likelihood = partial(frame_log_prob, model)
    for step in run_particles(model, encoded, number, systematic, log_likelihood, dtype=torch.float64):
        fivo.append(step.increment)  # (B,)
        ess.append(effective_sample_size(step.log_weight) / number)
    scores = {"fivo": torch.stack(fivo, 1), "ess": torch.stack(ess, 1)}  # (B, T)
    return {name: values * batch.mask for name, values in scores.items()}


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
    encoded = model.encode(batch.observation[:, :context], batch.action[:, :context])
    target = model.likelihood.target(batch.observation[:, context:]).flatten(0, 1)  # (B (T - c), *O)
    future = batch.action[:, context:].repeat(model.particles, 1, 1)  # (N B, T - c, A)
    joint, marginal = LogMeanExp(), LogMeanExp()
    for _ in range(model.num_belief_samples(number)):
        features = model.imagine(model.sample_beliefs(encoded, model.particles), future).features  # (N B, T - c, F)
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
