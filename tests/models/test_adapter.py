"""A model behind `ModelAdapter` has the scores that it has natively; with draws alone, within the Monte-Carlo error."""

import math
from functools import partial

import pytest
import torch
from small_models import BATCH, TIME, random_model, sequences
from torch.distributions import Distribution

from forbes.data import SequenceBatch, SequenceDataModule, Simulated
from forbes.errors import ForbesError
from forbes.evaluation.calibration.self_calibration import self_calibration
from forbes.evaluation.runs import split_batches
from forbes.evaluation.scores import (
    frame_log_prob,
    score_open_loop,
    score_particles,
    score_predictions,
    score_trajectories,
)
from forbes.evaluation.scoring import evaluate, exact_scorer, score_split
from forbes.models import Likelihood, ModelAdapter, State
from forbes.models.base import BOUNDS
from forbes.pomdps import LinearGaussian
from forbes.seeding import forked


class Head(Distribution):
    """A belief head with its context, as a distribution of torch."""

    def __init__(self, head, context):
        super().__init__(context.shape[:-1], torch.Size([head.state_dim]), validate_args=False)
        self.head, self.context = head, context

    def sample(self, sample_shape=()):
        return self.head.rsample(self.context)[0]

    def log_prob(self, value):
        return self.head.log_prob(value, self.context)


class Draws(ModelAdapter):
    """A state-space model of forbes, of which only draws, a roll-out and a decoder are known."""

    def __init__(self, model):
        super().__init__()
        self.model, self.likelihood = model, model.likelihood

    def initial(self, batch):
        return self.model.initial(batch)

    def embed_target(self, target):
        return self.model.embed_target(target.double())

    def observe(self, before, action, embedding):
        filtered = self.model.step(before, embedding, action)
        return State(filtered.hidden, filtered.state)

    def predict(self, before, action):
        hidden = self._advance(before, action)
        return State(hidden, self.model.prior.rsample(self.model.prior_context(hidden))[0])

    def decode_state(self, state):
        return self.model.decode(torch.cat(state, -1))

    def _advance(self, before, action):
        return self.model.gru(self.model.transition(torch.cat((before.state, action), -1)), before.hidden)


class Densities(Draws):
    """The same with densities."""

    observe, predict = ModelAdapter.observe, ModelAdapter.predict

    def advance(self, before, action):
        return self._advance(before, action)

    def prior(self, hidden):
        return Head(self.model.prior, self.model.prior_context(hidden))

    def posterior(self, hidden, embedding):
        context = self.model.posterior_context(torch.cat((hidden, embedding), -1))
        return Head(self.model.posterior, context)


def batch_of(observation, action, mask):
    nothing = torch.zeros(*mask.shape)
    return SequenceBatch(observation, action, nothing, mask, nothing[..., None], mask & False)


SCORES = {
    "elbo": partial(score_trajectories, number=3, predict=False),
    "pll": partial(score_predictions, number=3),
    "fivo": partial(score_particles, number=4),
    "open-loop": partial(score_open_loop, number=5, context=2),
}


@pytest.mark.parametrize("score", SCORES.values(), ids=SCORES)
@pytest.mark.parametrize("kind", ["gaussian", "flow", "categorical"])
def test_a_wrapped_model_has_its_own_scores_with_the_same_noise(kind, score):
    model, batch = random_model(kind), batch_of(*sequences())
    native, wrapped = [], []

    for found, each in ((native, model), (wrapped, Densities(model))):
        with forked("cpu", 7):
            found.append(score(each, batch))

    assert native[0].keys() == wrapped[0].keys()
    for name, values in native[0].items():
        torch.testing.assert_close(wrapped[0][name], values, rtol=1e-9, atol=1e-9)


def test_self_calibration_of_a_wrapped_model_is_its_own():
    model = random_model("gaussian")
    action = sequences()[1].repeat(6, 1, 1)[:, :3]

    native, wrapped, drawn = (self_calibration(each, action, 9) for each in (model, Densities(model), Draws(model)))

    assert torch.equal(native.value, wrapped.value)
    assert torch.equal(native.density, wrapped.density)
    assert torch.equal(native.tarp, wrapped.tarp)
    assert drawn.density is None
    assert drawn.value.shape == native.value.shape


def one_step(model, batch, count):
    """Samples of p̂(o_t | o_<t) of every step, `(count, B, T)`."""
    encoded = model.encode(batch.observation, batch.action)
    with torch.no_grad():
        each = [model.predictive_log_prob(encoded, partial(frame_log_prob, model)) for _ in range(count)]
    return torch.stack(each).exp()


class NoStep(Draws):
    """A wrong roll-out: nothing moves."""

    def predict(self, before, action):
        return before


@pytest.mark.parametrize(("kind", "same"), [(Draws, True), (NoStep, False)])
def test_draws_alone_estimate_the_same_prequential_score(kind, same):
    """Five standard errors of both means: one false alarm in 10^5 for 15 numbers."""
    model, (observation, action, mask) = random_model("gaussian"), sequences()
    batch = batch_of(observation[:, :3], action[:, :3], mask[:, :3])
    torch.manual_seed(0)

    native, drawn = one_step(model, batch, 300), one_step(kind(model), batch, 1500)

    difference = native.mean(0) - drawn.mean(0)
    error = (native.var(0) / len(native) + drawn.var(0) / len(drawn)).sqrt()
    assert bool((difference.abs() < 5 * error).all()) == same


def test_scores_that_need_a_density_are_not_available():
    model = random_model("gaussian")

    assert Draws(model).lacks == BOUNDS
    assert Densities(model).lacks == ()
    assert set(score_predictions(Draws(model), batch_of(*sequences()), 2)) == {"pll"}


class Sequence(Densities):
    """A model without steps: it reads a whole sequence at once."""

    def beliefs(self, embedding, action):
        filtered = self.model.filter(embedding, action)
        return State(filtered.hidden, filtered.state)


def test_a_model_without_steps_has_all_scores_but_fivo():
    model, batch = random_model("gaussian"), batch_of(*sequences())
    assert Sequence(model).lacks == ("fivo", "ess")

    for score in ("elbo", "pll", "open-loop"):
        with forked("cpu", 7):
            native = SCORES[score](model, batch)
        with forked("cpu", 7):
            found = SCORES[score](Sequence(model), batch)
        for name, values in native.items():
            torch.testing.assert_close(found[name], values, rtol=1e-9, atol=1e-9)


class Known(Likelihood):
    """N(o; m, v + R) of a Kalman filter's prediction, whose output is (m, v): a likelihood of one's own."""

    name, rank = "kalman", 1

    def target(self, observation):
        return observation.double()

    def mean(self, output):
        raise NotImplementedError

    sample = mean

    def log_prob(self, output, target):
        variance = output[..., 1:] + PROCESS.observation_variance
        return (-0.5 * (target - output[..., :1]).square() / variance - 0.5 * (2 * math.pi * variance).log()).sum(-1)


PROCESS = LinearGaussian(transition=0.9, transition_variance=0.3, observation_variance=0.5)


class Kalman(ModelAdapter):
    """The exact filter, written by hand: the hidden state is the mean and variance of the belief; nothing is drawn."""

    likelihood = Known()

    def __init__(self):
        super().__init__()
        self.transition = torch.nn.Parameter(torch.tensor(0.9, dtype=torch.float64))

    def initial(self, batch):
        before = (PROCESS.initial_variance - PROCESS.transition_variance) / 0.9**2
        belief = torch.tensor([0.0, before], dtype=torch.float64).expand(batch, 2)
        return State(belief, belief[:, :0])

    def observe(self, before, action, embedding):
        mean, variance = self.predict(before, action).hidden.split(1, -1)
        gain = variance / (variance + PROCESS.observation_variance)
        return State(torch.cat((mean + gain * (embedding - mean), (1 - gain) * variance), -1), before.state)

    def predict(self, before, action):
        mean, variance = before.hidden.split(1, -1)
        moved = (self.transition * mean, self.transition**2 * variance + PROCESS.transition_variance)
        return State(torch.cat(moved, -1), before.state)

    def decode_state(self, state):
        return state.hidden


def test_an_exact_filter_has_the_exact_evidence_as_its_score():
    data = SequenceDataModule(Simulated(PROCESS, train=2, validation=2, test=20), length=12)

    found = evaluate(
        Kalman().eval(), data, ["elbo", "pll", "open-loop"], sequences=20, particles=1, futures=1, context=4
    )

    exact = score_split(Kalman(), split_batches(data, "test", 20, 20), exact_scorer(PROCESS)).total("log_p")
    assert set(found) == {"pll", "open_loop", "open_loop_marginal"}
    assert found["pll"].mean == pytest.approx(exact.mean().item(), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "missing"), [("predict", "observe"), ("observe", "predict"), ("prior", "predict")], ids=lambda name: name
)
def test_an_adapter_without_a_roll_out_or_draws_is_refused(name, missing):
    methods = {each: lambda *_: None for each in ("initial", "decode_state", name)}

    with pytest.raises(ForbesError, match=f"Half: has no {missing}. Implement observe and predict, or advance"):
        type("Half", (ModelAdapter,), methods)()


def test_a_filter_of_an_adapter_starts_at_the_start():
    adapter = Draws(random_model("gaussian"))
    with pytest.raises(ForbesError, match=r"starts at `initial`, found a start\. Call `observe`"):
        adapter.filter(torch.zeros(2, 3, 1), torch.zeros(2, 3, 0), adapter.initial(2))


def test_an_adapter_is_not_trained():
    with pytest.raises(ForbesError, match="Draws: an adapter is scored, not trained"):
        Draws(random_model("gaussian")).lower_bound(*sequences())


def test_beliefs_and_futures_have_the_rows_of_the_native_model():
    model, (observation, action, _) = random_model("gaussian"), sequences()
    for adapter in (Draws(model), Densities(model)):
        belief = adapter.sample_beliefs(adapter.encode(observation, action), 3)
        rollout = adapter.imagine(belief, action[:, :4].repeat(3, 1, 1))

        assert belief.hidden.shape == (3 * BATCH, 7)
        assert rollout.features.shape == (3 * BATCH, 4, 11)
        assert rollout.log_prob.isnan().all()
        assert adapter.decode(rollout.features).shape == (3 * BATCH, 4, 1, 6, 6)
        assert adapter.predictive_log_prob(adapter.encode(observation, action), adapter.log_likelihood).shape == (
            BATCH,
            TIME,
        )
