r"""The scores of a linear-Gaussian process, whose evidence is known: what they estimate, and in which order they stand.

Its posterior is p(s_t | s_{t-1}, o_t): exact for the first state, blind to later observations for the others.
"""

import math

import pytest
import torch
from linear_gaussian import drawn, gaussian, log_evidence

from forbes.data import SequenceBatch
from forbes.evaluation import score_open_loop, score_particles, score_trajectories
from forbes.evaluation.smc import effective_sample_size, systematic_resampling

ROUNDING = 1e-4  # of float32, in nats


def copies(observation, number):
    """The same sequence so many times, as a batch."""
    stored = (observation.float() + 0.5).expand(number, *observation.shape).unflatten(-1, (1, 1, 3))  # (N, T, 1, 1, 3)
    mask = torch.ones(stored.shape[:2], dtype=torch.bool)
    none = torch.zeros(*mask.shape, 0)
    return SequenceBatch(stored, none, torch.zeros(mask.shape), mask, none)


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


def test_systematic_resampling_chooses_each_particle_as_often_as_its_weight_says():
    log_weight = torch.tensor([0.5, 0.25, 0.2, 0.05], dtype=torch.float64).log()[:, None].expand(4, 1000)
    uniform = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000

    chosen = systematic_resampling(log_weight, uniform)
    counts = torch.nn.functional.one_hot(chosen, 4).sum(0)  # (1000, 4)

    expected = 4 * log_weight[:, 0].exp()
    assert (counts.double() - expected).abs().max() < 1  # the floor or the ceiling of K W_k
    torch.testing.assert_close(counts.double().mean(0), expected, rtol=0, atol=1e-3)  # the grid of u


def test_the_effective_sample_size_counts_equal_weights():
    weight = torch.tensor([[1.0, 0.5, 0.25], [0.0, 0.5, 0.25], [0.0, 0.0, 0.25], [0.0, 0.0, 0.25]])
    torch.testing.assert_close(effective_sample_size(weight.log()), torch.tensor([1.0, 2.0, 4.0]))
