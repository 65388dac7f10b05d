"""Predict the rest of a sequence from its beginning."""

from typing import NamedTuple

import torch
from torch import Tensor

from forbes.data import SequenceBatch, SequenceData, SequenceSource, Split, Strokes
from forbes.errors import ForbesError
from forbes.models import BeliefModel, EncodedSequence, Rollout, State, StateSpaceModel
from forbes.shapes import printed_by_shape

__all__ = ["Completions", "complete", "expected_frames", "filter", "first_of_each_class", "imagine", "open_loop_frames"]
__all__ += ["true_frames", "whole_sequences"]


@printed_by_shape
class Completions(NamedTuple):
    """Sampled futures of some sequences after their first `context` steps."""

    frames: Tensor
    """Images in [0, 1] of steps context + 1 … T, `(N, B, T - context, C, H, W)`."""
    context: int
    """Number of steps that the model saw."""

    def at(self, time: int) -> Tensor:
        """Return the frames of step `time`, counted from 1 as in the paper, `(N, B, C, H, W)`.

        Raises:
            ForbesError: if the step was not completed: seen, or after the last.
        """
        last = self.context + self.frames.shape[2]
        if not self.context < time <= last:
            raise ForbesError(f"Completions: step {time} was not completed, expected {self.context + 1} to {last}")
        return self.frames[:, :, time - self.context - 1]


def true_frames(model: BeliefModel, source: SequenceSource, batch: SequenceBatch) -> Tensor:
    """Return the true images as grey values in [0, 1], as those of the model's means, `(B, T, C, H, W)`."""
    return source.pictures(model.likelihood.images(model.likelihood.picture(batch.observation)))


@torch.no_grad()
def filter(model: BeliefModel, batch: SequenceBatch, samples: int = 1) -> State:
    """Sample the belief over (h, s) after the last step of each sequence, given all its observations and actions.

    Args:
        model: `world.model` of a `WorldModel`, on the batch's device.
        batch: B sequences of T steps. Padding is filtered too, so cut sequences that end earlier.
        samples: number of samples per sequence, N, from torch's global generator.

    Returns:
        h, shape `(N B, H)`, and s, shape `(N B, D)`, sample-major: sample n of sequence b is in row n B + b.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> model = forbes.WorldModel.for_data(data).model
        >>> batch = data.sequences("test", torch.arange(8))
        >>> belief = forbes.filter(model, batch, samples=10)
        >>> belief.hidden.shape, belief.state.shape
        (torch.Size([80, 200]), torch.Size([80, 8]))
    """
    return model.sample_beliefs(model.encode(batch.observation, batch.action), samples)


@torch.no_grad()
def imagine(model: BeliefModel, belief: State, action: Tensor) -> Rollout:
    """Roll out belief samples without observations, each on its own trajectory.

    Args:
        model: `world.model` of a `WorldModel`, on the belief's device.
        belief: N samples for each of B sequences, as `filter` returns them.
        action: action that leads to each step, shape `(B, T, A)`, the same for all N samples of a sequence. Without
            actions A = 0: `torch.zeros(B, T, 0)`.

    Returns:
        T steps after `belief`, shape `(N B, T, ...)`. `model.decode(rollout.features)` returns the parameters of the
        likelihood; `model.likelihood` has their mean, samples and log-density.

    Raises:
        ForbesError: if the number of belief samples is not a multiple of the number of sequences.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> model = forbes.WorldModel.for_data(data).model
        >>> batch = data.sequences("test", torch.arange(8))
        >>> rollout = forbes.imagine(model, forbes.filter(model, batch, samples=10), action=torch.zeros(8, 5, 0))
        >>> model.likelihood.sample(model.decode(rollout.features)).shape
        torch.Size([80, 5, 1, 28, 28])
    """
    samples, rest = divmod(len(belief.hidden), len(action))
    if rest:
        raise ForbesError(
            f"imagine: the belief has {len(belief.hidden)} rows, expected a multiple of the {len(action)} sequences of "
            "action. Give the actions of all sequences, once"
        )
    return model.imagine(belief, action.repeat(samples, 1, 1))  # action (N B, T, A)


@torch.no_grad()
def complete(
    model: BeliefModel, source: SequenceSource, batch: SequenceBatch, context: int, samples: int, mean: bool = False
) -> Completions:
    r"""Filter the first `context` steps, draw N belief samples of (h, s), and roll each out to the batch's last step.

    Each sample keeps its own trajectory, so its completion is consistent over time. A model without randomness has one
    trajectory. A frame is :math:`E[o_t \mid h_t, s_t]`; of several parts it has the images side by side. If
    observations are increments, it is the drawing so far: the observed strokes plus sampled ones,
    :math:`o_u \sim p(\cdot \mid h_u, s_u)`, step by step.

    Args:
        model: model on the batch's device.
        source: data source of the batch.
        batch: B sequences of T steps, T above `context`.
        context: number of steps that the model sees.
        samples: number of samples per sequence, N.
        mean: for increments, use the expectation instead of a sample: the probability of each pixel, in grey.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> model = forbes.WorldModel.for_data(data).model
        >>> batch = data.sequences("test", torch.arange(8))
        >>> forbes.complete(model, data.source, batch, context=15, samples=10).frames.shape
        torch.Size([10, 8, 15, 1, 28, 28])
    """
    past = batch.first(context)
    encoded = model.encode(past.observation, past.action)
    frames = _futures(model, source, batch, encoded, samples, draw=source.increments and not mean)
    return Completions(frames, context)


@torch.no_grad()
def expected_frames(
    model: BeliefModel, source: SequenceSource, batch: SequenceBatch, context: int, futures: int
) -> Tensor:
    r"""Return the mean of K futures, an unbiased estimate of :math:`E[o_t \mid o_{1:c}]`, `(B, T - c, C, H, W)`.

    If observations are increments, it is that of the drawing so far. Given a trajectory of (h, s) the expectation is
    exact, since its frames are then independent.

    Args:
        model: model on the batch's device.
        source: data source of the batch.
        batch: B sequences of T steps, T above `context`.
        context: number of steps that the model sees, c.
        futures: number of futures, K, in whole sets of particles. A model without randomness has one.
    """
    past = batch.first(context)
    encoded = model.encode(past.observation, past.action)
    passes = model.num_belief_samples(futures)
    total: Tensor = _futures(model, source, batch, encoded, model.particles, draw=False).mean(0)
    for _ in range(passes - 1):  # one at a time: the memory does not grow with K
        total += _futures(model, source, batch, encoded, model.particles, draw=False).mean(0)
    return total / passes


def _futures(
    model: BeliefModel, source: SequenceSource, batch: SequenceBatch, encoded: EncodedSequence, samples: int, draw: bool
) -> Tensor:
    """Roll out N belief samples after the encoded steps and return their frames, `(N, B, T - context, C, H, W)`.

    Frames are drawn from the likelihood, or are its mean.
    """
    context = encoded.action.shape[1]
    start = model.sample_beliefs(encoded, samples)  # (N B, ...)
    action = batch.action[:, context:].repeat(samples, 1, 1)  # (N B, T - context, A)
    output = model.decode(model.imagine(start, action).features)  # (N B, T - context, C, H, W)
    frames = model.likelihood.images(model.likelihood.sample(output) if draw else model.likelihood.mean(output))
    if source.increments:
        before = batch.observation[:, :context].repeat(samples, 1, 1, 1, 1)  # (N B, context, C, H, W)
        frames = source.pictures(torch.cat((before.to(frames.dtype), frames), 1))[:, context:]
    return frames.view(samples, len(batch.mask), *frames.shape[1:])  # (N, B, T - context, C, H, W)


@torch.no_grad()
def open_loop_frames(model: StateSpaceModel, batch: SequenceBatch, context: int) -> Tensor:
    """Return E[o_t | features] in [0, 1], `(B, T, C, H, W)`, along one trajectory of each sequence.

    Up to `context` the features are the posterior's, given o_t. Later ones are a rollout of the prior from the belief
    at `context` with the recorded actions.

    Args:
        model: model on the batch's device.
        batch: B sequences of T steps, T above `context`.
        context: number of steps that the model sees.
    """
    past = batch.first(context)
    filtered = model.filter(model.embed(past.observation), past.action)
    imagined = model.imagine(filtered.at(-1), batch.action[:, context:])
    features = torch.cat((filtered.features, imagined.features), 1)  # (B, T, H + D)
    return model.likelihood.images(model.likelihood.mean(model.decode(features)))


def whole_sequences(data: SequenceData, split: Split, index: Tensor) -> SequenceBatch:
    """Return sequences up to the end of the longest one, with at least the data module's own length.

    Those that have no end even at eight times that length have the module's.
    """
    for length in (data.length, 2 * data.length, 4 * data.length, 8 * data.length):
        batch = data.sequences(split, index, length)
        if not batch.mask[:, -1].any():
            return batch.first(max(data.length, int(batch.mask.sum(1).max())))  # (B, longest, ...)
    return batch.first(data.length)  # (B, T, ...)


def first_of_each_class(data: SequenceData, split: Split, count: int) -> Tensor:
    """Return indices of the first sequence of each class, then the second of each, …: `(count,)`, int64.

    Without classes, return the first indices of the split.
    """
    size = data.source.size(split)
    if not isinstance(data.source, Strokes):
        return torch.arange(min(count, size))
    labels = data.source.labels(split)
    turn = torch.empty_like(labels)  # how many of its class came before
    for label in labels.unique():
        turn[labels == label] = torch.arange(int((labels == label).sum()))
    return torch.argsort(turn * (labels.max() + 1) + labels, stable=True)[:count]
