"""The evaluated bound is its definition, sequence by sequence and step by step."""

import math

import pytest
import torch
from torch import nn

from forbes.beliefs import BeliefHead, FlowBelief, GaussianBelief
from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.evaluation.elbo import Bound, Estimate, evaluate_elbo, paired_difference, sample_terms
from forbes.models import Bernoulli, MLPDecoder, MLPEncoder, Normal, StateSpaceModel
from forbes.seeding import derive_seed

SHAPE, STEPS = (1, 4, 4), 5


class Certain(BeliefHead):
    """A belief without randomness, so that a loop of another order and shape has the same samples."""

    def __init__(self, state_dim, context_dim):
        super().__init__(state_dim, context_dim)
        self.state = nn.Linear(context_dim, state_dim)

    def rsample(self, context, sample_shape=()):
        state = self.state(context).expand(*sample_shape, *context.shape[:-1], self.state_dim)
        return state, self.log_prob(state, context)

    def log_prob(self, state, context):
        return -(state - context[..., : self.state_dim]).square().sum(-1)


def make_model(belief=Certain, likelihood=None, actions=2):
    torch.manual_seed(0)
    encoder, decoder = MLPEncoder(SHAPE, 6, 1), MLPDecoder(4 + 3, SHAPE, 6, 1)
    model = StateSpaceModel(belief, encoder, decoder, likelihood or Bernoulli(), actions, 3, 4, 8, 2)
    return model.double().eval()


def make_batch(sequences=7, actions=2):
    generator = torch.Generator().manual_seed(1)
    length = torch.randint(1, STEPS + 1, (sequences, 1), generator=generator)
    return SequenceBatch(
        observation=torch.randint(0, 2, (sequences, STEPS, *SHAPE), generator=generator, dtype=torch.uint8),
        action=torch.randn(sequences, STEPS, actions, generator=generator, dtype=torch.float64),
        reward=torch.zeros(sequences, STEPS),
        mask=torch.arange(STEPS) < length,
    )


def in_batches(batch, size):
    starts = range(0, len(batch.mask), size)
    return [(start, SequenceBatch(*(values[start : start + size] for values in batch))) for start in starts]


@pytest.fixture(autouse=True)
def float64(monkeypatch):
    """Observations become float64 too, so that a tolerance says something about the formula."""
    monkeypatch.setattr(Bernoulli, "target", lambda self, observation: observation.double())
    monkeypatch.setattr(Normal, "target", lambda self, observation: observation.double() / self.scale - 0.5)
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)


def plain_elbo(model, observation, action, steps):
    """J of one sequence, a step at a time: filter, decode, compare (DESIGN §5)."""
    hidden, state = model.initial(1)
    total = 0.0
    for t in range(steps):
        hidden = model.gru(model.transition(torch.cat((state, action[t : t + 1]), -1)), hidden)
        target = model.likelihood.target(observation[t : t + 1])
        context = model.posterior_context(torch.cat((hidden, model.encoder(target)), -1))
        state, log_posterior = model.posterior.rsample(context)
        log_prior = model.prior.log_prob(state, model.prior_context(hidden))
        logits = model.decoder(torch.cat((hidden, state), -1))
        if isinstance(model.likelihood, Normal):
            density = torch.distributions.Normal(logits, model.likelihood.std, validate_args=False)
        else:
            density = torch.distributions.Bernoulli(logits=logits)
        total += (density.log_prob(target).sum() - log_posterior + log_prior).item()
    return total


@pytest.mark.parametrize("likelihood", [Bernoulli(), Normal(0.7, scale=1.0)], ids=lambda likelihood: likelihood.name)
@pytest.mark.parametrize("batch_size", [1, 3, 7])
def test_equals_a_plain_loop_over_sequences_and_steps(likelihood, batch_size, monkeypatch):
    monkeypatch.setattr("forbes.evaluation.elbo._FRAMES", 4)  # several parts, and the last one shorter
    model, batch = make_model(likelihood=likelihood), make_batch()

    bound = evaluate_elbo(model, in_batches(batch, batch_size), samples=2)

    with torch.no_grad():
        expected = [
            plain_elbo(model, observation, action, int(mask.sum()))
            for observation, action, _, mask in zip(*batch, strict=True)
        ]
    torch.testing.assert_close(bound.elbo, torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(bound.reconstruction - bound.kl, bound.elbo)
    assert bound.steps.tolist() == batch.mask.sum(1).tolist()


@pytest.mark.parametrize("belief", [GaussianBelief, FlowBelief])
def test_its_samples_are_estimates_of_the_bound_that_is_trained(belief):
    model, batch = make_model(belief), make_batch()
    with torch.no_grad():
        torch.manual_seed(3)
        reconstruction, kl = sample_terms(model, batch, samples=3)
        torch.manual_seed(3)
        expected = [model.elbo(batch.observation, batch.action, batch.mask) for _ in range(3)]

    torch.testing.assert_close(reconstruction, torch.stack([terms.reconstruction for terms in expected]))
    torch.testing.assert_close(kl, torch.stack([terms.kl for terms in expected]))


def test_the_reported_value_is_the_mean_over_samples_and_depends_on_the_seed_alone():
    model, batch = make_model(FlowBelief), make_batch()
    bound = evaluate_elbo(model, in_batches(batch, 7), samples=4, seed=2)

    with torch.no_grad():
        torch.manual_seed(derive_seed(2, "evaluation", 0))
        bounds = [model.elbo(batch.observation, batch.action, batch.mask).elbo for _ in range(4)]

    torch.testing.assert_close(bound.elbo, torch.stack(bounds).mean(0))
    other = evaluate_elbo(model, in_batches(batch, 7), samples=4, seed=3)
    assert (other.elbo != bound.elbo).all()


def test_what_lies_on_padding_does_not_count():
    model, batch = make_model(FlowBelief), make_batch()
    other = torch.where(batch.mask[:, :, None, None, None], batch.observation, 1 - batch.observation)

    bound = evaluate_elbo(model, in_batches(batch, 4), samples=2)
    changed = evaluate_elbo(model, in_batches(batch._replace(observation=other), 4), samples=2)

    assert not torch.equal(other, batch.observation)
    torch.testing.assert_close(changed.elbo, bound.elbo, rtol=0, atol=0)


def test_leaves_the_random_state_as_it_was():
    model = make_model(FlowBelief)
    before = torch.get_rng_state()

    evaluate_elbo(model, in_batches(make_batch(), 4), samples=2)

    assert torch.equal(torch.get_rng_state(), before)


def test_a_value_that_is_not_a_number_is_named():
    batch = make_batch()
    observation = batch.observation.double()
    observation[5, 0] = torch.nan

    with pytest.raises(ForbesError, match=r"^runs/a, test split: the ELBO of sequence 5 is nan"):
        evaluate_elbo(make_model(), in_batches(batch._replace(observation=observation), 3), where="runs/a, test split")


def test_a_paired_difference_is_the_mean_of_differences_with_its_error():
    first = torch.tensor([-10.0, -20.0, -60.0, -30.0], dtype=torch.float64)
    second = torch.tensor([-11.0, -24.0, -61.0, -36.0], dtype=torch.float64)
    bounds = [Bound(elbo, elbo, elbo, torch.ones(4)) for elbo in (first, second)]

    # By hand: differences 1, 4, 1, 6; mean 3; squares around it 4 + 1 + 4 + 9 = 18; √(18 / 3) / √4.
    assert paired_difference(*bounds) == pytest.approx(Estimate(3.0, math.sqrt(6) / 2))


def test_nats_per_step_divide_all_nats_by_all_steps():
    elbo = torch.tensor([-10.0, -20.0, -60.0], dtype=torch.float64)
    steps = torch.tensor([2.0, 3.0, 5.0], dtype=torch.float64)

    estimate = Bound(elbo, elbo, elbo, steps).per_step()

    # By hand: -90 / 10; what each sequence is above -9 a step is 8, 7, -15, over 10 / 3 steps.
    assert estimate.mean == pytest.approx(-9.0)
    assert estimate.standard_error == pytest.approx(math.sqrt((8**2 + 7**2 + 15**2) / 2) * 0.3 / math.sqrt(3))
