"""What every model promises, whatever its filter. A new one is one line in MODELS of `small_models.py`."""

import pytest
import torch
from small_models import (
    ACTION,
    BATCH,
    HIDDEN,
    MODELS,
    PARTS,
    SHAPE,
    TIME,
    make_model,
    random_model,
    random_state,
    sequences,
)

from forbes.models import EncodedSequence, State, elbo_loss

T = 3  # a step in the middle, counted from 0


@pytest.fixture(params=MODELS, name="kind")
def kind_fixture(request):
    return request.param


def seeded(function, *arguments, seed=0):
    torch.manual_seed(seed)
    with torch.no_grad():
        return function(*arguments)


def changed(observation, steps):
    """The same sequences with other frames at some steps."""
    other = observation.clone()
    other[:, steps] = 1 - other[:, steps]
    return other


def cut(encoded, steps):
    return EncodedSequence(*(values[:, :steps] for values in encoded))


def without_gradient(model):
    return [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]


def test_a_predictive_likelihood_depends_on_nothing_later(kind):
    model, (observation, action, _) = random_model(kind), sequences()
    steered = action.clone()
    steered[:, T] += 1

    first, of_frame, of_action = (
        seeded(model.predictive_log_prob, model.encode(*inputs), model.log_likelihood)
        for inputs in [(observation, action), (changed(observation, T), action), (observation, steered)]
    )

    assert first.shape == (BATCH, TIME)
    for other in (of_frame, of_action):  # the action of index T leads to o_T
        torch.testing.assert_close(other[:, :T], first[:, :T], rtol=0, atol=0)
        # In some sequence: a small layer of ReLUs may be silent for one, and one-hot draws may be the same.
        assert (other[:, T] != first[:, T]).any()


def test_the_bound_of_a_prefix_is_the_prefix_of_the_bound(kind):
    """The noise of a step does not depend on how many steps follow."""
    model, batch = random_model(kind), sequences()

    whole = seeded(model.lower_bound, *batch)
    prefix = seeded(model.lower_bound, *(values[:, :T] for values in batch))

    torch.testing.assert_close(prefix.reconstruction, whole.reconstruction[:, :T])
    torch.testing.assert_close(prefix.kl, whole.kl[:, :T], rtol=1e-6, atol=1e-6)  # decoded in float32


def test_a_belief_depends_on_all_that_was_seen_and_nothing_more(kind):
    model, (observation, action, _) = random_model(kind), sequences()
    belief = seeded(model.sample_beliefs, cut(model.encode(observation, action), T), 4)

    for step in range(TIME):
        other = seeded(model.sample_beliefs, cut(model.encode(changed(observation, step), action), T), 4)
        same = all(map(torch.equal, belief, other))
        assert same == (step >= T)


def test_beliefs_keep_the_sequence_they_belong_to(kind):
    """Draws are sample-major: with all sequences the same but one, its rows are the ones that differ."""
    model, (observation, action, _) = random_model(kind), sequences()
    observation[:], action[:] = observation[:1].clone(), action[:1].clone()
    encoded = model.encode(observation, action)
    observation[2] = 1 - observation[2]
    others = model.encode(observation, action)

    belief, other = (seeded(model.sample_beliefs, each, 4) for each in (encoded, others))

    assert len(belief.hidden) == len(belief.state) == 4 * BATCH
    differs = (belief.hidden != other.hidden).any(-1).view(4, BATCH)
    assert differs.any(0).tolist() == [False, False, True, False, False]  # one-hot draws may be the same by chance


def test_beliefs_of_a_model_with_a_state_differ(kind):
    model, (observation, action, _) = random_model(kind), sequences()

    belief = torch.cat(seeded(model.sample_beliefs, model.encode(observation, action), 3 * model.particles), -1)

    if PARTS[kind].get("state_dim") == 0:
        assert len(belief.unique(dim=0)) == BATCH
    else:
        assert len(belief.unique(dim=0)) > 2 * BATCH


def test_imagination_keeps_its_rows_apart(kind, same_noise):
    model, (_, action, _) = random_model(kind), sequences()
    start = random_state(model)

    rollout = model.imagine(start, action)
    alone = model.imagine(State(*(x[2:3] for x in start)), action[2:3])

    assert rollout.features.shape[:2] == (BATCH, TIME)
    for of_row, of_batch in zip(alone, rollout, strict=True):
        torch.testing.assert_close(of_row, of_batch[2:3])


def test_a_batch_of_one_equals_that_row_of_a_batch(kind, same_noise):
    model, (observation, action, mask) = random_model(kind), sequences()

    batch = model.lower_bound(observation, action, mask)
    row = model.lower_bound(observation[2:3], action[2:3], mask[2:3])

    torch.testing.assert_close(row.reconstruction, batch.reconstruction[2:3], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(row.kl, batch.kl[2:3], rtol=1e-6, atol=1e-6)


def test_gradients_reach_every_parameter(kind):
    model = random_model(kind)

    elbo_loss(model.lower_bound(*sequences())).backward()

    assert without_gradient(model) == []


def test_gradients_reach_every_parameter_by_the_second_update(kind):
    """The flow's last layers start at zero and block those before them, once."""
    model = make_model(kind)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)

    for _ in range(2):
        optimizer.zero_grad()
        elbo_loss(model.lower_bound(*sequences())).backward()
        optimizer.step()

    assert without_gradient(model) == []


def test_padding_changes_neither_loss_nor_gradients(kind):
    model, (observation, action, mask) = random_model(kind), sequences()
    mask[0, 2:] = mask[1, 1:] = mask[3, 5:] = False
    noisy_observation = torch.where(mask[..., None, None, None], observation, 1 - observation)
    noisy_action = torch.where(mask[..., None], action, 100.0)
    results = []

    for inputs in [(observation, action), (noisy_observation, noisy_action)]:
        torch.manual_seed(0)
        loss = elbo_loss(model.lower_bound(*inputs, mask), free_nats=0.1, free_nats_per="element")
        results.append((loss, *torch.autograd.grad(loss, list(model.parameters()))))

    torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)


def test_cutting_padding_off_changes_nothing(kind):
    model, (observation, action, mask) = random_model(kind), sequences()
    mask[:, 4:] = False

    padded = seeded(model.lower_bound, observation, action, mask)
    shorter = seeded(model.lower_bound, observation[:, :4], action[:, :4], mask[:, :4])

    torch.testing.assert_close(elbo_loss(padded), elbo_loss(shorter))


def test_a_process_without_actions_needs_no_dummy(kind):
    model, (observation, _, mask) = make_model(kind, action_dim=0), sequences()
    no_action = torch.zeros(BATCH, TIME, 0, dtype=torch.float64)

    assert model.lower_bound(observation, no_action, mask).elbo.isfinite().all()
    assert model.imagine(model.initial(BATCH), no_action).hidden.shape == (BATCH, TIME, HIDDEN)


def test_decoding_keeps_the_leading_dimensions(kind):
    model = random_model(kind)
    features = model.imagine(random_state(model), torch.zeros(BATCH, TIME, ACTION, dtype=torch.float64)).features

    output = model.decode(features)

    assert output.shape == (BATCH, TIME, *SHAPE)
    torch.testing.assert_close(output[1, 2], model.decoder(features[1, 2:3])[0])


def test_a_saved_and_loaded_model_gives_identical_outputs(kind, tmp_path):
    model, other, batch = random_model(kind, seed=0), random_model(kind, seed=1), sequences()
    torch.save(model.state_dict(), tmp_path / "model.pt")
    other.load_state_dict(torch.load(tmp_path / "model.pt", weights_only=True))
    results = []

    for each in (model, other):
        terms = seeded(each.lower_bound, *batch)
        results.append((terms.reconstruction, terms.kl, *seeded(each.imagine, each.initial(BATCH), batch[1])))

    torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)


# One of each kind of state: `test_gradients_reach_every_parameter` has them all.
@pytest.mark.parametrize("kind", ["gaussian", "flow", "categorical", "vector"])
def test_overfits_one_batch(kind):
    """A random pixel costs 0.69 nats until it is remembered, then what it takes to say which of the five sequences."""
    model, batch = make_model(kind, width=64), sequences()
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    torch.manual_seed(0)
    mean_frame = torch.distributions.Bernoulli(batch[0].double().mean(0))
    untold = mean_frame.entropy().sum().item() / TIME  # the least that a model pays which cannot tell them apart

    bounds = []
    for _ in range(250):
        terms = model.lower_bound(*batch)
        optimizer.zero_grad()
        elbo_loss(terms).backward()
        optimizer.step()
        bounds.append(terms.elbo.mean().item() / TIME)

    assert bounds[0] < -untold
    assert sum(bounds[-20:]) / 20 > -untold / 2
