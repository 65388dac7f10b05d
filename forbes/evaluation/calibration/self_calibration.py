r"""Self-calibration: is the filter of a trained model exact for the model's own process? Needs no ground truth.

Sample :math:`(s, o)` from the model's prior, filter o, and rank the sampled :math:`s_t` among samples of the belief
:math:`q(s_t \mid o_{1:t})`. The ranks are uniform if the belief is the exact filtering posterior of the model
(simulation-based calibration, Talts et al., 2018, arXiv 1804.06788). A filter trained with the ELBO is expected to
fail: its beliefs are too narrow (`forbes theorem`), and the ranks pile up at both ends. It never reconsiders an earlier
state; a belief of weighted particles, with the same posterior as their proposal, does.
"""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.errors import ForbesError
from forbes.evaluation.calibration.ranks import TwoSampleTest, ranks, tarp_ranks, two_sample_test
from forbes.evaluation.scores import LogMeanExp
from forbes.models import BeliefModel, EncodedSequence, Filtered, PosteriorModel, has_posterior
from forbes.models.particles import sample_weighted_beliefs
from forbes.seeding import derive_seed, forked, generator

__all__ = ["SelfCalibration", "self_calibration"]

_COMPONENTS = 20
"""Number of posterior trajectories in the mixture that estimates the belief's density. The ranks are uniform for any
function of (s, o), so also for this estimate."""


class SelfCalibration(NamedTuple):
    """Ranks of N sampled states among L samples of their beliefs, 0 to L."""

    value: Tensor
    """Rank of each dimension of s_t, `(N, D)`."""
    density: Tensor | None
    """Rank of the belief's log-density, a mixture over posterior trajectories, `(N,)`; None if it has none."""
    tarp: Tensor
    """Rank of the distance from a random point, `(N,)`."""
    classifier: TwoSampleTest
    """Test that separates the sampled state from one sample of its belief, given the mean of the others."""


@torch.no_grad()
def self_calibration(
    model: BeliefModel, action: Tensor, samples: int, seed: int = 0, particles: int | None = None
) -> SelfCalibration:
    """Rank the last state of each sequence that the model imagines.

    Args:
        model: model in eval mode, on the action's device.
        action: actions of N sequences up to the step that is checked, `(N, t, A)`.
        samples: number of samples per belief, L. Each uses its own trajectory, since the belief is over (h, s).
        seed: random seed for all samples.
        particles: K, to check `sample_weighted_beliefs` in place of the model's own beliefs.

    Raises:
        ForbesError: if there are weighted particles to check, but the model's posterior has no density.
    """
    draw_belief = partial(model.sample_beliefs, samples=1)
    if particles is not None:
        if not has_posterior(model):
            raise ForbesError("a belief without a density cannot be weighted. Leave out --particles")
        draw_belief = partial(sample_weighted_beliefs, model, number=particles)
    with forked(action.device, derive_seed(seed, "self-calibration", 0)):
        rollout = model.imagine(model.initial(len(action)), action)
        observation = model.likelihood.sample(model.decode(rollout.features))  # (N, t, *O)
        encoded = EncodedSequence(observation, model.embed_target(observation), action)
        truth = rollout.state[:, -1]  # (N, D)
        draws = torch.stack([draw_belief(encoded).state for _ in range(samples + 1)])  # (L + 1, N, D)
        log_belief = _log_belief(model, encoded, torch.cat((truth[None], draws[1:]))) if has_posterior(model) else None
    draw = generator(seed, "ties", 0)
    truth, draws = truth.double().cpu(), draws.double().cpu()
    return SelfCalibration(
        value=ranks(truth, draws[1:], draw),
        density=None if log_belief is None else ranks(log_belief[0], log_belief[1:], draw),
        tarp=tarp_ranks(truth, draws, draw),
        classifier=two_sample_test(truth, draws, generator(seed, "classifier", 0)),
    )


def _log_belief(model: PosteriorModel, encoded: EncodedSequence, state: Tensor) -> Tensor:
    """Estimate the log-density of the last belief of each sequence at `(L, N, D)`: nats, `(L, N)`, on the CPU."""
    density = LogMeanExp()
    for _ in range(_COMPONENTS):
        filtered = model.filter(encoded.embedding, encoded.action)
        last = Filtered(*(values[:, -1:] for values in filtered))  # (N, 1, ...)
        density.add(model.posterior_log_prob(state[:, :, None], last)[..., 0].double())
    return density.result().cpu()
