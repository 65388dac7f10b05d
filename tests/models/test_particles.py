"""Particles: their bound where the evidence is known, their belief against Kalman's, and how they are redrawn."""

import math
from functools import partial

import pytest
import torch
from linear_gaussian import EMISSION, NOISE, bounds, drawn, gaussian, log_evidence
from small_models import random_model, sequences

from forbes.beliefs import GaussianBelief
from forbes.errors import ForbesError
from forbes.models import ConvDecoder, ConvEncoder, ModelParts, ParticleModel, StateSpaceModel
from forbes.models.particles import effective_sample_size, run_particles, soft, systematic, systematic_resampling
from forbes.training import WorldModel

ROUNDING = 1e-4  # of float32, in nats or units of the state
RESAMPLING = {"systematic": systematic, "soft": soft}


@pytest.fixture(params=RESAMPLING, name="resampling")
def resampling_fixture(request):
    return request.param


def particle_model(particles, resampling="systematic"):
    """The mean of its proposal lies half a standard deviation aside, so that there is something to weigh."""
    model, exact = gaussian(partial(ParticleModel, particles=particles, resampling=resampling))
    with torch.no_grad():
        model.posterior.parameters_of.bias[:2] += 0.2
    return model, exact


def log_weights(number=8, sequences=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (2 * torch.randn(number, sequences, generator=generator, dtype=torch.float64)).log_softmax(0)


def grid_of_u(monkeypatch, number):
    """Let the sequences' u be every k / number in its middle: a mean over sequences is the expectation."""
    uniform = (torch.arange(number, dtype=torch.float64) + 0.5) / number
    monkeypatch.setattr(torch, "rand_like", lambda values: uniform)


def kalman(observation, transition, covariance):
    """Means of p(s_t | o_1:t) and of p(s_t | o_1:t-1), each (T, 2)."""
    emission, mean, spread = EMISSION.double(), torch.zeros(2, dtype=torch.float64), torch.zeros(2, 2).double()
    filtered, predicted = [], []
    for seen in observation:
        predicted.append(transition @ mean)
        spread = transition @ spread @ transition.T + covariance
        gain = spread @ emission.T @ torch.linalg.inv(emission @ spread @ emission.T + NOISE**2 * torch.eye(3))
        mean = predicted[-1] + gain @ (seen - emission @ predicted[-1])
        spread = spread - gain @ emission @ spread
        filtered.append(mean)
    return torch.stack(filtered), torch.stack(predicted)


def seen_by(model, observation, copies):
    """The same sequence so many times."""
    stored = (observation.float() + 0.5).expand(copies, *observation.shape).unflatten(-1, (1, 1, 3))
    return model.encode(stored, torch.zeros(*stored.shape[:2], 0))


def assert_mean_is(values, expected):
    """Of independent rows, within four standard errors."""
    error = values.std(0) / math.sqrt(len(values))
    assert ((values.mean(0) - expected).abs() < 4 * error + ROUNDING).all()


@pytest.mark.usefixtures("same_noise")
@pytest.mark.parametrize("kl", ["monte_carlo", "path"])
def test_one_particle_is_the_state_space_model(resampling, kl):
    plain, batch = random_model("gaussian"), sequences()
    like = {name: getattr(plain, name) for name in ("encoder", "decoder", "likelihood", "state_dim", "hidden_dim")}
    parts = ModelParts(GaussianBelief, **like, action_dim=2, mlp_dim=9, mlp_layers=2)
    one = ParticleModel(parts, particles=1, resampling=resampling).double()
    one.load_state_dict(plain.state_dict())

    terms, expected = one.lower_bound(*batch, kl), plain.lower_bound(*batch, kl)
    gradients, plain_gradients = (
        torch.autograd.grad(each.elbo.sum(), list(model.parameters()))
        for each, model in [(terms, one), (expected, plain)]
    )

    # Pixels are decoded in float32, and the KL is a difference of the two.
    torch.testing.assert_close(terms.reconstruction, expected.reconstruction, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(terms.kl, expected.kl, rtol=1e-6, atol=1e-5)
    torch.testing.assert_close(gradients, plain_gradients, rtol=1e-5, atol=1e-6)


def test_the_exponential_of_the_bound_averages_to_the_evidence(resampling):
    model, exact = particle_model(4, resampling)
    observation = drawn(4, seed=4)
    torch.manual_seed(0)

    ratio = (bounds(model, observation, 20_000) - log_evidence(observation, *exact)).exp()

    assert_mean_is(ratio, 1)


def test_particles_are_redrawn_in_some_sequences_only(resampling):
    """Without this, the tests of the bound would not see how they are redrawn."""
    model, _ = particle_model(4, resampling)
    encoded = seen_by(model, drawn(4, seed=4), 1000)
    torch.manual_seed(0)

    first, second, *_ = model._run(encoded)

    redrawn = effective_sample_size(first.log_weight) < 2
    assert 50 < redrawn.sum() < 950
    kept = (second.log_before == first.log_weight).all(0)
    assert torch.equal(kept, ~redrawn)


def test_more_particles_give_a_tighter_bound(resampling):
    observation = drawn(10, seed=10)
    torch.manual_seed(0)

    one, four, sixteen = (bounds(particle_model(number, resampling)[0], observation, 400) for number in (1, 4, 16))

    evidence = log_evidence(observation, *particle_model(1)[1])
    for looser, tighter in [(one, four), (four, sixteen)]:
        error = (looser.var() + tighter.var()).sqrt() / math.sqrt(400)
        assert tighter.mean() - looser.mean() > 4 * error
    assert sixteen.mean() < evidence + 4 * sixteen.std() / math.sqrt(400) + ROUNDING


def test_beliefs_match_the_kalman_filter_unlike_trajectories(resampling):
    (model, exact), observation = particle_model(500, resampling), drawn(4, seed=4)
    filtered, _ = kalman(observation, exact[0], exact[2])
    torch.manual_seed(0)
    encoded = seen_by(model, observation, 400)

    with torch.no_grad():
        state = model.sample_beliefs(encoded, 20).state.view(20, 400, 2).double()
        trajectories = StateSpaceModel.sample_beliefs(model, encoded, 20).state.view(20, 400, 2).double()

    assert_mean_is(state.mean(0), filtered[-1])
    with pytest.raises(AssertionError):
        assert_mean_is(trajectories.mean(0), filtered[-1])


def test_predictions_are_those_of_the_kalman_filter(resampling):
    (model, exact), observation = particle_model(500, resampling), drawn(4, seed=4)
    _, predicted = kalman(observation, exact[0], exact[2])
    torch.manual_seed(0)

    def coordinate(features, target, d):
        """A likelihood of 20 + s_d, whose mean tells that of s_d."""
        return (20 + features[..., -2 + d].double()).log()

    with torch.no_grad():
        encoded = seen_by(model, observation, 400)
        likelihoods = (partial(coordinate, d=d) for d in range(2))
        state = torch.stack([model.predictive_log_prob(encoded, each).exp() - 20 for each in likelihoods], -1)

    assert_mean_is(state, predicted)  # (400, T, 2)


def test_a_belief_is_drawn_as_often_as_its_weights_say(monkeypatch):
    model, _ = particle_model(8)
    with torch.no_grad():
        *_, last = model._run(seen_by(model, drawn(1, seed=1), 1))
    filtered = last.filtered._replace(
        hidden=last.filtered.hidden.repeat_interleave(1000, 0),
        state=torch.arange(8.0).repeat_interleave(1000)[:, None],  # each particle has its number
    )
    particles = last._replace(filtered=filtered, log_weight=log_weights().expand(8, 1000))
    grid_of_u(monkeypatch, 1000)
    monkeypatch.setattr(model, "_run", lambda encoded: iter([particles]))

    for samples in (1, 5):
        drawn_states = model.sample_beliefs(None, samples).state.flatten().long()

        shares = torch.bincount(drawn_states, minlength=8) / (1000 * samples)
        torch.testing.assert_close(shares.double(), log_weights()[:, 0].exp(), rtol=0, atol=1e-3)  # the grid of u


@pytest.mark.parametrize("number", [3, 8])  # of few, weights that were normalised again would be off by 0.016
def test_redrawn_particles_stand_for_the_same_measure(resampling, number, monkeypatch):
    """The mean over u of Σ W' f of the children is Σ W f, for every f: for that of one particle alone, too."""
    log_weight = log_weights(number, seed=2).expand(number, 1000)
    grid_of_u(monkeypatch, 1000)

    ancestor, log_child = RESAMPLING[resampling](log_weight)

    chosen = torch.nn.functional.one_hot(ancestor, number).double()  # (K, 1000, K)
    measure = (log_child.exp()[..., None] * chosen).sum(0).mean(0)  # (K,)
    torch.testing.assert_close(measure, log_weight[:, 0].exp(), rtol=0, atol=1e-3)  # the grid of u


def test_only_soft_resampling_passes_gradients_to_the_weights():
    log_weight = log_weights(sequences=3).requires_grad_()
    torch.manual_seed(0)

    _, child = systematic(log_weight)
    _, soft_child = soft(log_weight)

    assert not child.requires_grad
    (gradient,) = torch.autograd.grad(soft_child.sum(), log_weight)
    assert (gradient != 0).any(0).all()


def test_systematic_resampling_draws_particles_by_their_weight():
    log_weight = torch.tensor([0.5, 0.25, 0.2, 0.05], dtype=torch.float64).log()[:, None].expand(4, 1000)
    uniform = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000

    for number in (4, 7):
        chosen = systematic_resampling(log_weight, uniform, number)
        counts = torch.nn.functional.one_hot(chosen, 4).sum(0).double()  # (1000, 4)

        expected = number * log_weight[:, 0].exp()
        assert (counts - expected).abs().max() < 1  # the floor or the ceiling of N W_k
        torch.testing.assert_close(counts.mean(0), expected, rtol=0, atol=number * 1e-3)  # the grid of u


def test_the_effective_sample_size_counts_equal_weights():
    weight = torch.tensor([[1.0, 0.5, 0.25], [0.0, 0.5, 0.25], [0.0, 0.0, 0.25], [0.0, 0.0, 0.25]])
    torch.testing.assert_close(effective_sample_size(weight.log()), torch.tensor([1.0, 2.0, 4.0]))


def test_hidden_and_stochastic_states_are_redrawn_together():
    """Each particle's h_t is the GRU's of the pair that its ancestor carried; all have one h_1, so take h_3."""
    model, (observation, action, _) = random_model("particles"), sequences()
    encoded = model.encode(observation, action)
    generator = torch.Generator().manual_seed(0)
    scores = 100 * torch.rand(observation.shape[1], 3, len(observation), generator=generator, dtype=torch.float64)
    scores[0] = 0  # at the first step hardly any is redrawn, then every sequence, so unequal are the weights
    given = iter(scores)
    torch.manual_seed(0)

    _, before, after, *_ = run_particles(
        model, encoded, 3, systematic, lambda features, target: (next(given), {}), dtype=torch.float64
    )

    parents = torch.cat((before.filtered.state, action[:, 2].repeat(3, 1)), -1)  # (3 B, D + A)
    moved = model.gru(model.transition(parents), before.filtered.hidden)
    was, parent, child = (h.unflatten(0, (3, -1)) for h in (before.filtered.hidden, moved, after.filtered.hidden))
    same = (child[:, None] - parent[None]).abs().amax(-1) < 1e-9  # (child, parent, B)
    assert (was.diff(dim=0).abs().amax(-1) > 1e-6).any()  # h tells particles apart
    assert same.any(1).all()
    assert (effective_sample_size(before.log_weight) < 1.5).all()
    assert not same.diagonal(dim1=0, dim2=1).all()


def test_images_of_many_frames_have_the_reparameterised_gradient():
    """They are decoded from one pixel by a product, here with frozen weights."""
    world = WorldModel(
        observation_shape=(1, 16, 16),
        belief=GaussianBelief,
        model=partial(ParticleModel, particles=3),
        encoder=partial(ConvEncoder, channels=2),
        decoder=partial(ConvDecoder, channels=2),
        kl="path",
        state_dim=2,
        hidden_dim=4,
        mlp_dim=4,
    )
    observation = torch.randint(2, (2, 6, 1, 16, 16), dtype=torch.uint8)
    mask = torch.ones(2, 6, dtype=torch.bool)

    world.model.lower_bound(observation, torch.zeros(2, 6, 0), mask, kl="path").elbo.sum().backward()

    assert all(parameter.grad.isfinite().all() for parameter in world.model.decoder.parameters())


def test_what_cannot_be_is_said_in_one_sentence():
    with pytest.raises(ForbesError, match="ParticleModel: particles is 0, expected at least 1"):
        particle_model(0)
    with pytest.raises(ForbesError, match=r"100 particles or futures, expected whole sets of 8.*multiple of 8"):
        particle_model(8)[0].num_belief_samples(100)
    assert particle_model(8)[0].num_belief_samples(128) == 16
