"""The model without a stochastic state: its likelihood is one, and it learns to roll on without observations."""

import itertools

import pytest
import torch
from small_models import BATCH, HIDDEN, TIME, random_model, sequences

from forbes.beliefs import GaussianBelief
from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.evaluation.scores import score_predictions
from forbes.models import MLPDecoder, MLPEncoder, ModelParts, OneHot, VectorModel, elbo_loss


@pytest.fixture
def model():
    return random_model("vector")


def make_vector_model(state_dim=0, overshoot=2):
    """Of sequences of three symbols."""
    torch.manual_seed(0)
    encoder, decoder = MLPEncoder((3,), 5, 1), MLPDecoder(6, (3,), 5, 1)
    sizes = {"action_dim": 0, "state_dim": state_dim, "hidden_dim": 6, "mlp_dim": 7, "mlp_layers": 1}
    return VectorModel(ModelParts(GaussianBelief, encoder, decoder, OneHot(), **sizes), overshoot)


def chain_rule(model, observation, action):
    """log p(o_t | o_<t) of each step, from networks alone."""
    hidden, before = model.initial(len(observation))
    each = []
    for t in range(observation.shape[1]):
        hidden = model.gru(model.transition(torch.cat((before, action[:, t]), -1)), hidden)
        target = model.likelihood.target(observation[:, t]).double()
        each.append(model.likelihood.log_prob(model.decoder(hidden), target))
        before = model.encoder(target)
    return torch.stack(each, 1)


def rolled_on(model, observation, action, start, steps):
    """log p of so many steps after `start`, which itself and all later ones are not seen, from networks alone."""
    hidden, before = model.initial(1)
    for t in range(start + 1):
        hidden = model.gru(model.transition(torch.cat((before, action[None, t]), -1)), hidden)
        before = model.encoder(model.likelihood.target(observation[None, t]).double())
    total = torch.zeros((), dtype=torch.float64)
    for t in range(start + 1, start + 1 + steps):
        hidden = model.gru(model.transition(torch.cat((model.nothing[None], action[None, t]), -1)), hidden)
        total += model.likelihood.log_prob(model.decoder(hidden), observation[None, t].double())[0]
    return total


def test_the_bound_is_the_likelihood_by_the_chain_rule(model):
    observation, action, mask = sequences()

    terms = model.lower_bound(observation, action, mask)

    torch.testing.assert_close(terms.reconstruction, chain_rule(model, observation, action), rtol=1e-6, atol=1e-6)
    assert not terms.kl.any()


def test_the_probabilities_of_all_sequences_add_up_to_one():
    """Else a prediction had seen what it predicts."""
    model, symbols = make_vector_model(), torch.eye(3)
    observation = symbols[torch.tensor(list(itertools.product(range(3), repeat=4)))]  # (81, 4, 3)
    mask = torch.ones(81, 4, dtype=torch.bool)

    log_p = model.lower_bound(observation, torch.zeros(81, 4, 0), mask).elbo

    assert log_p.double().exp().sum().item() == pytest.approx(1, abs=1e-5)  # of float32


def test_its_prequential_score_is_the_likelihood_for_any_number_of_particles(model):
    observation, action, mask = sequences()
    mask[0, 3:] = False
    none = torch.zeros(BATCH, TIME, 0)

    for number in (1, 50):
        scores = score_predictions(model, SequenceBatch(observation, action, none[..., 0:0], mask, none, ~mask), number)

        assert set(scores) == {"pll"}
        torch.testing.assert_close(scores["pll"].sum(1), model.lower_bound(observation, action, mask).elbo.double())


def test_filtering_goes_on_from_where_it_stopped(model):
    observation, action, _ = sequences()
    embedding = model.embed(observation)

    whole = model.filter(embedding, action)
    first = model.sample_beliefs(model.encode(observation[:, :3], action[:, :3]), 1)
    second = model.filter(embedding[:, 3:], action[:, 3:], first)

    torch.testing.assert_close(second, whole[:, 3:])


def test_the_first_imagined_step_is_the_prediction_and_later_ones_see_nothing(model):
    observation, action, _ = sequences()
    encoded = model.encode(observation, action)
    belief = model.sample_beliefs(model.encode(observation[:, :3], action[:, :3]), 2)

    rollout = model.imagine(belief, action[:, 3:].repeat(2, 1, 1))

    features = rollout.features.view(2, BATCH, TIME - 3, HIDDEN)
    torch.testing.assert_close(features[0], features[1])
    predicted = model.predictive_log_prob(encoded, model.log_likelihood)[:, 3]
    torch.testing.assert_close(model.log_likelihood(features[0, :, 0], encoded.target[:, 3]), predicted)
    hidden = features[0, :, 0]
    for t in range(4, TIME):
        inputs = torch.cat((model.nothing.expand(BATCH, -1), action[:, t]), -1)
        hidden = model.gru(model.transition(inputs), hidden)
        torch.testing.assert_close(features[0, :, t - 3], hidden)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.65, 0.999])
def test_overshooting_is_the_mean_over_the_steps_after_a_start_of_each_sequences_own(model, share, monkeypatch):
    monkeypatch.setattr(torch, "rand", lambda *shape, **options: torch.full(shape, share))
    observation, action, mask = sequences()
    lengths = [6, 1, 2, 4, 6]
    for row, length in enumerate(lengths):
        mask[row, length:] = False

    loss = model.lower_bound(observation, action, mask).auxiliary["overshoot"]

    total, steps = torch.zeros((), dtype=torch.float64), 0
    for row, length in enumerate(lengths):
        start = int(share * (length - 1))
        inside = min(model.overshoot, length - 1 - start)
        total += rolled_on(model, observation[row], action[row], start, inside)
        steps += inside
    torch.testing.assert_close(loss, -total / steps, rtol=1e-6, atol=1e-6)


def test_every_step_but_the_last_is_a_start_sooner_or_later(model):
    starts = set()

    def note(start, action, imagine=model.imagine):
        starts.update((start.hidden[:, None] == hidden).all(-1).nonzero()[:, 1].tolist())
        return imagine(start, action)

    observation, action, mask = sequences()
    hidden = model.filter(model.embed(observation), action)
    model.imagine = note
    torch.manual_seed(0)
    for _ in range(20):  # of five sequences: one of five starts is missed with probability 5 (4/5)^100 = 1e-9
        model.lower_bound(observation, action, mask)

    assert starts == set(range(TIME - 1))


def test_overshooting_teaches_what_to_do_without_observations(model):
    terms = model.lower_bound(*sequences())

    (by_overshoot,) = torch.autograd.grad(terms.auxiliary["overshoot"], model.nothing, retain_graph=True)
    (by_later_steps,) = torch.autograd.grad(terms.reconstruction[:, 1:].sum(), model.nothing, retain_graph=True)
    parts = torch.autograd.grad(elbo_loss(terms), model.nothing)[0]

    assert by_overshoot.ne(0).any()
    (by_bound,) = torch.autograd.grad(-model.lower_bound(*sequences()).reconstruction.mean(), model.nothing)
    torch.testing.assert_close(parts, by_bound + by_overshoot, rtol=1e-4, atol=1e-6)
    assert by_later_steps.ne(0).any()  # through h_1


def test_sequences_of_one_step_have_nothing_to_roll_on(model):
    observation, action, mask = (values[:, :1] for values in sequences())

    terms = model.lower_bound(observation, action, mask)

    assert terms.auxiliary["overshoot"] == 0
    assert elbo_loss(terms).isfinite()


def test_what_cannot_be_is_said_in_one_sentence():
    with pytest.raises(ForbesError, match="VectorModel: state_dim is 8, expected 0, it has no stochastic state"):
        make_vector_model(state_dim=8)
    with pytest.raises(ForbesError, match="VectorModel: overshoot is 0, expected at least 1"):
        make_vector_model(overshoot=0)
