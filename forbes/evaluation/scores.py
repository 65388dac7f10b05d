r"""Scores of a model on sequences, by one convention.

Observation log-likelihoods only, fully normalised, in nats; no free nats; the Monte-Carlo KL for every family; padding
is not scored; log-probabilities are summed in float64. With
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
- PLL, the prequential log-likelihood, scores the filtering belief. Its particles are drawn from the belief after t - 1
  observations (h_t follows from it), and o_t is used only to score them. So it is a proper score of the belief, and its
  K-sample estimate is a lower bound of it (Jensen). The posterior helps to estimate the integral over s_t, without bias
  (`PosteriorModel.one_step_log_prob`). The weights of weighted particles enter the mean; a model without randomness
  has K = 1.
- FIVO (Maddison et al., 2017, arXiv 1705.09279) resamples, with the particles of `forbes.models.particles` and
  systematic resampling, regardless of the training objective.
- Open loop: the mean over particles is outside the product over time and inside the logarithm. This rewards a belief
  that holds the truth as one of several futures; the mean of logarithms would reward hedging.
"""

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.data import SequenceBatch
from forbes.models import BeliefModel, PosteriorModel, has_posterior
from forbes.models.particles import effective_sample_size, run_particles, systematic
from forbes.shapes import map_parts

__all__ = ["Increments", "LogMeanExp", "Trajectory", "frame_log_prob", "score_open_loop", "score_particles"]
__all__ += ["score_predictions", "score_trajectories", "trajectories"]

Increments = dict[str, Tensor]
"""Contribution of each step by score, `(B, T)`, in nats, float64. Their sum over t is the score of the sequence."""

_FRAMES = 1000
"""Number of frames decoded at a time: memory is bounded, and digits fit into the CPU cache (a third less time)."""


class Trajectory(NamedTuple):
    """One sample of the posterior along every sequence of a batch, in nats, float64."""

    reconstruction: Tensor
    """log p(o_t | h_t, s_t), `(B, T)`."""
    kl: Tensor
    """log q(s_t) - log p(s_t), `(B, T)`."""
    prediction: Tensor | None
    """An estimate of log p(o_t | h_t) (`PosteriorModel.one_step_log_prob`), `(B, T)`; None unless it was requested."""
    parts: dict[str, Tensor]
    """The reconstruction of each part by its name, `(B, T)`; empty for observations of one array."""


class LogMeanExp:
    r"""A running :math:`\log \frac1K \sum_k e^{x_k}`: the memory does not grow with K."""

    def __init__(self) -> None:
        self.count = 0
        self.total = torch.tensor(-math.inf, dtype=torch.float64)

    def add(self, value: Tensor) -> None:
        """Add one x_k, of any shape, the same in each call."""
        self.count += 1
        self.total = torch.logaddexp(self.total.to(value.device), value)

    def result(self) -> Tensor:
        """Return the log-mean-exp of the values added so far."""
        return self.total - math.log(self.count)


def frame_log_prob(model: BeliefModel, features: Tensor, target: Tensor) -> Tensor:
    """Return log p(o | features) in nats, float64, a few frames at a time.

    Args:
        model: model that decodes the features.
        features: model features, `(*, N, F)`.
        target: frames as returned by `Likelihood.target`, `(N, *O)`. Each is scored under every leading index.

    Returns:
        `(*, N)`.
    """
    return _frame_log_prob_by_part(model, features, target)[0]


def _frame_log_prob_by_part(model: BeliefModel, features: Tensor, target: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """See `frame_log_prob`; also that of each part by its name, where an observation has several."""
    size = max(1, _FRAMES // math.prod(features.shape[:-2]))
    chunks = [
        model.log_likelihood_by_part(chunk, frames)
        for chunk, frames in zip(features.split(size, -2), target.split(size), strict=True)
    ]
    whole = torch.cat([total.double() for total, _ in chunks], -1)  # (*, N)
    return whole, {name: torch.cat([parts[name].double() for _, parts in chunks], -1) for name in chunks[0][1]}


def trajectories(model: PosteriorModel, batch: SequenceBatch, number: int, predict: bool) -> Iterator[Trajectory]:
    """Sample trajectories one at a time, so that only one is in memory. The encoder runs once.

    Args:
        model: model in eval mode, on the batch's device.
        batch: B sequences.
        number: number of trajectories.
        predict: whether to sample one-step predictions as well.
    """
    # Encode once: with coarse pixels the encoder and the likelihood must share the same noise.
    encoded = model.encode(batch.observation, batch.action)
    target = encoded.target.flatten(0, 1)  # (B T, *O)

    def log_prob(features: Tensor) -> Tensor:
        return frame_log_prob(model, features.flatten(0, 1), target).view(batch.mask.shape)  # (B, T)

    for _ in range(number):
        filtered = model.filter(encoded.embedding, encoded.action)
        kl = filtered.log_prob - model.prior_log_prob(filtered)
        reconstruction, parts = (
            map_parts(lambda values: values.view(batch.mask.shape), each)  # (B, T)
            for each in _frame_log_prob_by_part(model, filtered.features.flatten(0, 1), target)
        )
        prediction = model.one_step_log_prob(filtered, reconstruction, log_prob) if predict else None
        yield Trajectory(reconstruction, kl.double(), prediction, parts)


@torch.no_grad()
def score_trajectories(model: PosteriorModel, batch: SequenceBatch, number: int, predict: bool) -> Increments:
    """Score a batch with K trajectories: `elbo`, `reconstruction`, `kl`, `iwae`, and `pll` if `predict` is set.

    The reconstruction of each of several parts is `reconstruction/NAME`.

    `iwae` at step t is the bound of the first t steps minus that of the first t - 1, so it sums to the whole bound.
    """
    mask = batch.mask.double()
    reconstruction, kl = torch.zeros_like(mask), torch.zeros_like(mask)
    by_part: dict[str, Tensor] = {}
    weight, prediction = LogMeanExp(), LogMeanExp()
    for trajectory in trajectories(model, batch, number, predict):
        reconstruction += trajectory.reconstruction / number
        kl += trajectory.kl / number
        for name, values in trajectory.parts.items():
            by_part[name] = by_part.get(name, torch.zeros_like(mask)) + values / number
        weight.add(((trajectory.reconstruction - trajectory.kl) * mask).cumsum(1))
        if trajectory.prediction is not None:
            prediction.add(trajectory.prediction)
    scores = {
        "elbo": reconstruction - kl,
        "reconstruction": reconstruction,
        "kl": kl,
        "iwae": weight.result().diff(dim=1, prepend=torch.zeros_like(mask[:, :1])),
        **{f"reconstruction/{name}": values for name, values in by_part.items()},
    }
    if predict:
        scores["pll"] = prediction.result()
    return {name: values * mask for name, values in scores.items()}


@torch.no_grad()
def score_predictions(model: BeliefModel, batch: SequenceBatch, number: int) -> Increments:
    """Score a batch with K particles: `pll`, and `iwae` if the model has a posterior."""
    if has_posterior(model) and model.particles == 1:
        return score_trajectories(model, batch, number, predict=True)  # the same trajectories give both scores
    encoded, prediction = model.encode(batch.observation, batch.action), LogMeanExp()
    for _ in range(model.num_belief_samples(number)):
        prediction.add(model.predictive_log_prob(encoded, partial(frame_log_prob, model)))
    scores = {"pll": prediction.result() * batch.mask}
    if has_posterior(model):
        scores |= score_trajectories(model, batch, number, predict=False)
    return scores


@torch.no_grad()
def score_particles(model: PosteriorModel, batch: SequenceBatch, number: int) -> Increments:
    """Score a batch with K particles: `fivo`, and `ess`, the effective sample size before resampling divided by K.

    Args:
        model: model in eval mode, on the batch's device.
        batch: B sequences; all K B particles are in memory at once.
        number: number of particles, K.
    """
    encoded, fivo, ess = model.encode(batch.observation, batch.action), [], []

    def log_likelihood(features: Tensor, target: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return frame_log_prob(model, features, target), {}

    for step in run_particles(model, encoded, number, systematic, log_likelihood, dtype=torch.float64):
        fivo.append(step.increment)  # (B,)
        ess.append(effective_sample_size(step.log_weight) / number)
    scores = {"fivo": torch.stack(fivo, 1), "ess": torch.stack(ess, 1)}  # (B, T)
    return {name: values * batch.mask for name, values in scores.items()}


@torch.no_grad()
def score_open_loop(model: BeliefModel, batch: SequenceBatch, number: int, context: int) -> Increments:
    """Score a batch with K futures: `open_loop`, and `open_loop_marginal`, which shows the loss with the horizon.

    The sum of `open_loop` over t is log p(o_{c+1:T} | o_{1:c}); `open_loop_marginal` is log p(o_t | o_{1:c}) of each
    step by itself. Both are 0 up to c. Each belief sample gives one future per particle. In an RSSM that is one future,
    from a posterior trajectory of its own, since the belief is over (h, s). A model without randomness has one future.

    Args:
        model: model in eval mode, on the batch's device.
        batch: B sequences of T steps.
        number: number of futures, K.
        context: number of steps that the model observes, c, from 1 to T - 1.
    """
    mask = batch.mask[:, context:].double()  # (B, T - c)
    past, later = batch.first(context), batch.after(context)
    encoded = model.encode(past.observation, past.action)
    target = model.likelihood.target(later.observation).flatten(0, 1)  # (B (T - c), *O)
    future = batch.action[:, context:].repeat(model.particles, 1, 1)  # (N B, T - c, A)
    joint, marginal = LogMeanExp(), LogMeanExp()
    for _ in range(model.num_belief_samples(number)):
        features = model.imagine(model.sample_beliefs(encoded, model.particles), future).features  # (N B, T - c, F)
        by_particle = features.view(model.particles, len(target), -1)  # (N, B (T - c), F)
        for log_prob in frame_log_prob(model, by_particle, target).view(-1, *mask.shape):  # N times (B, T - c)
            joint.add((log_prob * mask).cumsum(1))
            marginal.add(log_prob)
    before = torch.zeros_like(batch.mask[:, :context], dtype=torch.float64)  # (B, c)
    scores = {
        "open_loop": joint.result().diff(dim=1, prepend=torch.zeros_like(mask[:, :1])),
        "open_loop_marginal": marginal.result() * mask,
    }
    return {name: torch.cat((before, values), 1) for name, values in scores.items()}  # (B, T)
