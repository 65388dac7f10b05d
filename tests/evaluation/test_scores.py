"""The evaluated bound is its definition, sequence by sequence and step by step."""

from functools import partial

import pytest
import torch
from batches import batch_of
from torch import nn

from forbes.beliefs import BeliefHead, FlowBelief, GaussianBelief
from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.evaluation.scores import frame_log_prob, score_particles, trajectories
from forbes.evaluation.scoring import make_scorer, score_split
from forbes.models import Bernoulli, MLPDecoder, MLPEncoder, ModelParts, Normal, ParticleModel, StateSpaceModel
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


def make_model(belief=Certain, likelihood=None, actions=2, build=StateSpaceModel):
    torch.manual_seed(0)
    parts = ModelParts(
        belief=belief,
        encoder=MLPEncoder(SHAPE, 6, 1),
        decoder=MLPDecoder(4 + 3, SHAPE, 6, 1),
        likelihood=likelihood or Bernoulli(),
        action_dim=actions,
        state_dim=3,
        hidden_dim=4,
        mlp_dim=8,
        mlp_layers=2,
    )
    return build(parts).double().eval()


def make_batch(sequences=7, actions=2):
    generator = torch.Generator().manual_seed(1)
    length = torch.randint(1, STEPS + 1, (sequences, 1), generator=generator)
    return batch_of(
        observation=torch.randint(0, 2, (sequences, STEPS, *SHAPE), generator=generator, dtype=torch.uint8),
        action=torch.randn(sequences, STEPS, actions, generator=generator, dtype=torch.float64),
        mask=torch.arange(STEPS) < length,
    )


def in_batches(batch, size):
    starts = range(0, len(batch.mask), size)
    return [(start, SequenceBatch(*(values[start : start + size] for values in batch))) for start in starts]


def elbo(model, batches, samples, **options):
    """The pass that `forbes evaluate` makes; its scores summed over the steps, (N,)."""
    scores = score_split(model, batches, make_scorer("elbo", samples, 1, 1), **options)
    return {name: values.sum(1) for name, values in scores.values.items()}


def plain_elbo(model, observation, action, steps):
    """J of one sequence, a step at a time: filter, decode, compare."""
    hidden, state = model.initial(1)
    total = 0.0
    for t in range(steps):
        hidden = model.gru(model.transition(torch.cat((state, action[t : t + 1]), -1)), hidden)
        target = model.likelihood.target(observation[t : t + 1]).double()
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
    monkeypatch.setattr("forbes.evaluation.scores._FRAMES", 4)  # several parts, and the last one shorter
    model, batch = make_model(likelihood=likelihood), make_batch()

    scores = elbo(model, in_batches(batch, batch_size), samples=2)

    with torch.no_grad():
        expected = [
            plain_elbo(model, observation, action, int(mask.sum()))
            for observation, action, mask in zip(batch.observation, batch.action, batch.mask, strict=True)
        ]
    torch.testing.assert_close(scores["elbo"], torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(scores["reconstruction"] - scores["kl"], scores["elbo"])


def plain_future(model, observation, action, context):
    """log p of each later frame of one sequence: filter up to c, then roll on by the actions that were taken."""
    hidden, state = model.initial(1)
    found = []
    for t, frame in enumerate(observation):
        hidden = model.gru(model.transition(torch.cat((state, action[t : t + 1]), -1)), hidden)
        target = model.likelihood.target(frame[None]).double()
        seen = model.posterior_context(torch.cat((hidden, model.encoder(target)), -1))
        unseen = model.prior_context(hidden)
        state, _ = model.posterior.rsample(seen) if t < context else model.prior.rsample(unseen)
        logits = model.decoder(torch.cat((hidden, state), -1))
        found.append(torch.distributions.Bernoulli(logits=logits).log_prob(target).sum())
    return torch.stack(found[context:])


def test_an_open_loop_follows_the_actions_that_were_taken():
    model, batch, context = make_model(), make_batch(), 2

    scores = score_split(model, in_batches(batch, 3), make_scorer("open-loop", 2, 3, context)).values

    with torch.no_grad():
        futures = [plain_future(model, o, a, context) for o, a in zip(batch.observation, batch.action, strict=True)]
    expected = torch.cat((torch.zeros(7, context), torch.stack(futures)), 1) * batch.mask  # (N, T)
    for metric in ("open_loop", "open_loop_marginal"):  # the same where every future is
        torch.testing.assert_close(scores[metric], expected)


def test_frame_scores_are_float64_whatever_the_model_uses():
    """A logarithm of a mean over particles cancels: of 1e5 nats float32 loses 0.004."""
    model, batch = make_model(), make_batch()
    model.log_likelihood_by_part = lambda features, target: (torch.full(features.shape[:-1], -1e5), {})  # float32

    found = frame_log_prob(model, torch.zeros(3, STEPS, 7), batch.observation[0])

    assert found.dtype == torch.float64
    assert found.shape == (3, STEPS)


@pytest.mark.parametrize("belief", [GaussianBelief, FlowBelief])
def test_its_samples_are_estimates_of_the_bound_that_is_trained(belief):
    model, batch = make_model(belief), make_batch()
    with torch.no_grad():
        torch.manual_seed(3)
        drawn = list(trajectories(model, batch, 3, predict=False))
        torch.manual_seed(3)
        expected = [model.lower_bound(batch.observation, batch.action, batch.mask) for _ in range(3)]

    for trajectory, terms in zip(drawn, expected, strict=True):
        torch.testing.assert_close(trajectory.reconstruction, terms.reconstruction)
        torch.testing.assert_close(trajectory.kl, terms.kl)


class Grainy(Normal):
    """Each reading of a frame has noise of its own, as with fewer bits."""

    def target(self, observation):
        return super().target(observation) + torch.rand(observation.shape, dtype=torch.float64)


def test_encoder_and_likelihood_share_one_reading_of_a_frame():
    model, batch = make_model(GaussianBelief, Grainy(scale=1.0)), make_batch()
    with torch.no_grad():
        torch.manual_seed(3)
        (trajectory,) = trajectories(model, batch, 1, predict=False)
        torch.manual_seed(3)
        terms = model.lower_bound(batch.observation, batch.action, batch.mask)

    torch.testing.assert_close(trajectory.reconstruction, terms.reconstruction)
    torch.testing.assert_close(trajectory.kl, terms.kl)


def test_the_fivo_bound_is_the_one_that_particles_are_trained_by():
    model, batch = make_model(GaussianBelief, build=partial(ParticleModel, particles=5)), make_batch()
    torch.manual_seed(3)
    scores = score_particles(model, batch, 5)
    torch.manual_seed(3)
    with torch.no_grad():
        terms = model.lower_bound(batch.observation, batch.action, batch.mask)

    torch.testing.assert_close(scores["fivo"].sum(1), terms.elbo)
    assert (scores["ess"][batch.mask] < 0.5).any()


def test_reported_value_is_a_sample_mean_and_fixed_by_the_seed():
    model, batch = make_model(FlowBelief), make_batch()
    mine = elbo(model, in_batches(batch, 7), samples=4, seed=2)["elbo"]

    with torch.no_grad():
        torch.manual_seed(derive_seed(2, "evaluation", 0))
        bounds = [model.lower_bound(batch.observation, batch.action, batch.mask).elbo for _ in range(4)]

    torch.testing.assert_close(mine, torch.stack(bounds).mean(0))
    assert (elbo(model, in_batches(batch, 7), samples=4, seed=3)["elbo"] != mine).all()


def test_what_lies_on_padding_does_not_count():
    model, batch = make_model(FlowBelief), make_batch()
    other = torch.where(batch.mask[:, :, None, None, None], batch.observation, 1 - batch.observation)

    assert not torch.equal(other, batch.observation)
    for name, number in [("elbo", 2), ("pll", 2), ("fivo", 3), ("open-loop", 2)]:
        score = make_scorer(name, number, 4, context=2)
        true, changed = (
            score_split(model, in_batches(batch._replace(observation=values), 4), score)
            for values in (batch.observation, other)
        )
        for metric in score.metrics:
            torch.testing.assert_close(changed.values[metric], true.values[metric], rtol=0, atol=0)
            assert not true.values[metric][~batch.mask].any()


def test_leaves_the_random_state_as_it_was():
    model = make_model(FlowBelief)
    before = torch.get_rng_state()

    elbo(model, in_batches(make_batch(), 4), samples=2)

    assert torch.equal(torch.get_rng_state(), before)


def test_a_value_that_is_not_a_number_is_named():
    batch = make_batch()
    observation = batch.observation.double()
    observation[5, 0] = torch.nan

    with pytest.raises(ForbesError, match=r"^runs/a, test split: the elbo of sequence 5 is nan"):
        elbo(make_model(), in_batches(batch._replace(observation=observation), 3), 2, where="runs/a, test split")
