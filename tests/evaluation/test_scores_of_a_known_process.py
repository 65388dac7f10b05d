r"""The scores of a linear-Gaussian process, whose evidence is known: what they estimate, and in which order they stand.

Its posterior is p(s_t | s_{t-1}, o_t): exact for the first state, blind to later observations for the others.
"""

import math
from functools import partial

import pytest
import torch
from linear_gaussian import drawn, gaussian, log_evidence
from torch.nn.functional import softplus

from forbes.data import SequenceBatch
from forbes.evaluation import score_open_loop, score_particles, score_predictions, score_trajectories
from forbes.evaluation.scores import frame_log_prob
from forbes.models import ParticleModel

ROUNDING = 1e-4  # of float32, in nats


def copies(observation, number):
    """The same sequence so many times, as a batch."""
    stored = (observation.float() + 0.5).expand(number, *observation.shape).unflatten(-1, (1, 1, 3))  # (N, T, 1, 1, 3)
    mask = torch.ones(stored.shape[:2], dtype=torch.bool)
    none = torch.zeros(*mask.shape, 0)
    return SequenceBatch(stored, none, torch.zeros(mask.shape), mask, none, ~mask)


def known(steps):
    """The model, one sequence, and log p(o_{1:t}) for each t."""
    model, exact = gaussian()
    observation = drawn(steps, seed=steps)
    return model, observation, torch.stack([log_evidence(observation[: t + 1], *exact) for t in range(steps)])


def assert_mean_is_one(ratio):
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / math.sqrt(len(ratio)) + ROUNDING


@pytest.mark.parametrize("particles", [1, 4])
def test_the_exponentials_of_iwae_and_fivo_average_to_the_evidence(particles):
    """Each is log of an unbiased estimate of p(o_{1:T}), the one of FIVO through resampling too."""
    model, observation, evidence = known(steps=4)
    batch = copies(observation, 20_000)
    torch.manual_seed(0)

    iwae = score_trajectories(model, batch, particles, predict=False)["iwae"].sum(1)
    scores = score_particles(model, batch, particles)

    assert_mean_is_one((iwae - evidence[-1]).exp())
    assert_mean_is_one((scores["fivo"].sum(1) - evidence[-1]).exp())
    assert particles == 1 or ((scores["ess"] < 0.5).any() and (scores["ess"] > 0.5).any())


def test_the_bounds_stand_in_order_below_the_evidence():
    model, observation, evidence = known(steps=15)
    batch = copies(observation, 400)
    torch.manual_seed(0)

    scores = score_trajectories(model, batch, 16, predict=False)
    fivo = score_particles(model, batch, 16)["fivo"].sum(1)

    gaps = [evidence[-1] - bound for bound in (scores["elbo"].sum(1), scores["iwae"].sum(1), fivo)]
    error = 4 * max(gap.std().item() for gap in gaps) / math.sqrt(len(fivo))
    means = [gap.mean().item() for gap in gaps]
    assert means[0] > means[1] + error
    assert means[1] > means[2] + error
    assert means[2] > -error


def test_fivo_with_1024_particles_is_the_evidence_to_a_twentieth_of_a_nat():
    model, observation, evidence = known(steps=15)
    torch.manual_seed(0)

    fivo = score_particles(model, copies(observation, 16), 1024)["fivo"].sum(1)

    assert abs(fivo.mean() - evidence[-1]) < 0.05


def test_the_exponential_of_the_prequential_score_averages_to_the_one_step_predictive():
    """Of the first two steps, where the belief after the one before is exact."""
    model, observation, evidence = known(steps=2)
    torch.manual_seed(0)

    pll = score_trajectories(model, copies(observation, 50_000), 2, predict=True)["pll"]

    assert_mean_is_one((pll[:, 0] - evidence[0]).exp())
    assert_mean_is_one((pll[:, 1] - (evidence[1] - evidence[0])).exp())


def first_step(std_factor, shift):
    """A model with another posterior, 20,000 filtered first steps, log p̂(o_1) by the prior alone and by both."""
    model, observation, evidence = known(steps=1)
    with torch.no_grad():
        model.posterior.parameters_of.bias[:2] += shift
        std = softplus(model.posterior.parameters_of.bias[2:]) + model.posterior.min_std
        model.posterior.parameters_of.bias[2:] = (std_factor * std - model.posterior.min_std).expm1().log()
    batch = copies(observation, 20_000)
    torch.manual_seed(0)
    with torch.no_grad():
        encoded = model.encode(batch.observation, batch.action)
        score = partial(frame_log_prob, model)
        both = model.predictive_log_prob(encoded, score)[:, 0]
        hidden = model.filter(encoded.embedding, encoded.action).hidden
        state, _ = model.prior.rsample(model.prior_context(hidden))
        prior = score(torch.cat((hidden, state), -1)[:, 0], encoded.target[:, 0])
    return [(values - evidence[0]).exp() for values in (prior, both)]


@pytest.mark.parametrize(("std_factor", "shift"), [(1, 0), (0.3, 0), (3, 0), (1, 1.0)])
def test_the_predictive_likelihood_is_unbiased_for_every_posterior(std_factor, shift):
    """And never much worse than by the prior alone: its second moment is at most twice as large."""
    prior, both = first_step(std_factor, shift)

    assert_mean_is_one(both)
    assert both.square().mean() < 2 * prior.square().mean()


def test_a_good_posterior_makes_the_predictive_likelihood_precise():
    prior, both = first_step(1, 0)

    assert both.var() < 0.25 * prior.var()


def test_many_particles_of_the_exact_belief_reach_the_evidence():
    model, observation, evidence = known(steps=2)
    each = evidence.diff(prepend=torch.zeros(1))  # log p(o_t | o_{<t})
    torch.manual_seed(0)

    ratio = (score_trajectories(model, copies(observation, 5000), 1, predict=True)["pll"] - each).exp()
    pll = score_trajectories(model, copies(observation, 50), 100, predict=True)["pll"].sum(1)

    jensen = (ratio.var(0) / (2 * 100)).sum()  # what a mean of 100 loses inside the logarithm
    assert abs(pll.mean() + jensen - evidence[-1]) < 4 * pll.std() / math.sqrt(50) + ROUNDING


def test_the_exponential_of_the_open_loop_score_averages_to_the_likelihood_of_the_rest():
    model, observation, evidence = known(steps=4)
    torch.manual_seed(0)

    scores = score_open_loop(model, copies(observation, 50_000), 2, context=1)

    assert not scores["open_loop"][:, 0].any()
    assert_mean_is_one((scores["open_loop"].sum(1) - (evidence[-1] - evidence[0])).exp())
    # The first step after the context is on its own, too.
    assert_mean_is_one((scores["open_loop_marginal"][:, 1] - (evidence[1] - evidence[0])).exp())


def test_the_open_loop_score_is_the_logarithm_of_the_mean_of_likelihoods():
    """K futures of which one holds the truth cost at most log K, however much the others miss."""
    model, observation, _ = known(steps=3)
    torch.manual_seed(0)

    one = score_open_loop(model, copies(observation, 500), 1, context=1)["open_loop"].sum(1)
    many = score_open_loop(model, copies(observation, 1), 500, context=1)["open_loop"].sum()

    likelihood = one.exp()
    error = (likelihood.std() / likelihood.mean()).item() * math.sqrt(2 / 500)  # of the difference of two such means
    assert many.item() == pytest.approx(likelihood.mean().log().item(), abs=4 * error)
    assert many > one.mean() + 4 * error


@pytest.fixture
def poor_particles():
    """A model of 250 particles whose proposal lies aside, one sequence, and log p(o_{1:t}) for each t."""
    model, exact = gaussian(partial(ParticleModel, particles=250))
    with torch.no_grad():
        model.posterior.parameters_of.bias[:2] += 0.2
    observation = drawn(6, seed=6)
    torch.manual_seed(0)
    return model, observation, torch.stack([log_evidence(observation[: t + 1], *exact) for t in range(6)])


def test_the_prequential_score_of_particles_reaches_the_evidence_where_trajectories_do_not(poor_particles):
    model, observation, evidence = poor_particles

    pll = score_predictions(model, copies(observation, 25), 500)["pll"].sum(1)
    trajectories = score_trajectories(model, copies(observation, 20), 100, predict=True)["pll"].sum(1)

    error = 4 * pll.std() / math.sqrt(25)
    bias = 0.05  # six times a mean over 500 inside the logarithm, and over weighted particles
    assert abs(pll.mean() - evidence[-1]) < error + bias
    assert trajectories.mean() < evidence[-1] - 5 * (error + bias)


def test_the_open_loop_score_of_particles_is_the_likelihood_of_the_rest(poor_particles):
    model, observation, evidence = poor_particles

    scores = score_open_loop(model, copies(observation, 40), 2500, context=3)["open_loop"].sum(1)

    expected = evidence[-1] - evidence[2]
    assert abs(scores.mean() - expected) < 4 * scores.std() / math.sqrt(40) + scores.var() / 2 + 0.05


def test_particles_are_scored_by_the_bound_of_any_number_of_them(poor_particles):
    """FIVO is of the model and its proposal; the number it was trained with does not count."""
    model, observation, evidence = poor_particles

    fivo = score_particles(model, copies(observation, 16), 2000)["fivo"].sum(1)

    assert abs(fivo.mean() - evidence[-1]) < 4 * fivo.std() / 4 + fivo.var() / 2 + ROUNDING
