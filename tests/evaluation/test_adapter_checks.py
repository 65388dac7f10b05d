"""What an adapter gets wrong is one sentence, before anything is scored."""

import math

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal, OneHotCategorical

import forbes
from forbes.data import SequenceDataModule, Simulated
from forbes.errors import ForbesError
from forbes.evaluation.adapter_checks import check_model
from forbes.pomdps import LinearGaussian, Tiger

DATA = SequenceDataModule(Simulated(LinearGaussian(), train=4, validation=4, test=6), length=6, batch_size=4)
TIGER = SequenceDataModule(Simulated(Tiger(), train=4, validation=4, test=6), length=6, batch_size=4)


class Right(forbes.ModelAdapter):
    """A model with nothing wrong: a GRU and 3 Gaussian numbers."""

    likelihood = forbes.VectorNormal()

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.gru = nn.GRUCell(3, 5)
        self.prior_of, self.posterior_of, self.decoder = nn.Linear(5, 3), nn.Linear(6, 3), nn.Linear(8, 1)

    def initial(self, batch):
        return forbes.State(torch.zeros(batch, 5), torch.zeros(batch, 3))

    def advance(self, before, action):
        return self.gru(before.state, before.hidden)

    def prior(self, hidden):
        return Independent(Normal(self.prior_of(hidden), 1.0), 1)

    def posterior(self, hidden, embedding):
        return Independent(Normal(self.posterior_of(torch.cat((hidden, embedding), -1)), 0.5), 1)

    def decode_state(self, state):
        return self.decoder(torch.cat(state, -1))


class Draws(Right):
    """The same without densities."""

    def __init__(self):
        super().__init__()
        self.has_densities = False


class Smoother(Right):
    def embed_target(self, target):
        return target.flip(1).cumsum(1).flip(1)


class AttentionWithoutMask(Draws):
    def beliefs(self, embedding, action):
        hidden = embedding.mean(1, keepdim=True).expand(-1, embedding.shape[1], 5)
        return forbes.State(hidden, torch.zeros(*embedding.shape[:2], 3))


class BatchNorm(Right):
    def embed_target(self, target):
        return (target - target[:, :1].mean(0)) / target[:, :1].std(0)


class OwnNoise(Right):
    generator = torch.Generator().manual_seed(0)

    def advance(self, before, action):
        return super().advance(before, action) + torch.rand(1, generator=self.generator)


class InPlace(Right):
    def observe(self, before, action, embedding):
        embedding *= 0.5
        return super().observe(before, action, embedding)


class WideBatchShape(Right):
    def prior(self, hidden):
        return Normal(self.prior_of(hidden), 1.0)


class NoDistribution(Right):
    def prior(self, hidden):
        return self.prior_of(hidden)


class Tuples(Right):
    def initial(self, batch):
        return torch.zeros(batch, 5), torch.zeros(batch, 3)


class NotFinite(Right):
    def advance(self, before, action):
        return super().advance(before, action) * math.nan


class OtherHidden(Right):
    def predict(self, before, action):
        return forbes.State(before.hidden + 1, before.state)


class FlatDecoder(Right):
    def decode_state(self, state):
        return super().decode_state(state)[:, 0]


class NoLikelihood(Right):
    likelihood = None


class Images(Right):
    likelihood = forbes.Bernoulli()


class Swapped(Right):
    """The density of the prior is that of another distribution."""

    def prior(self, hidden):
        return Independent(Far(self.prior_of(hidden), 1.0), 1)


class Far(Normal):
    def log_prob(self, value):
        return super().log_prob(value) + 10


class Unnormalised(forbes.VectorNormal):
    """The square error of DreamerV3, without the constant of its Gaussian."""

    def __init__(self):
        super().__init__()
        self.name = "mse"

    def sample(self, output):
        return output + math.sqrt(0.5) * torch.randn_like(output)

    def log_prob(self, output, target):
        return -(output - target).square().sum(-1)


class Normalised(Unnormalised):
    """The same with the constant."""

    def log_prob(self, output, target):
        return super().log_prob(output, target) - 0.5 * math.log(math.pi) * target.shape[-1]


class OtherUnits(Normalised):
    def __init__(self):
        super().__init__()
        self.name = "normal(0.707107)"

    def target(self, observation):
        return observation.float() / 255


def test_a_model_that_sees_ahead_is_not_scored_in_python_either():
    with pytest.raises(ForbesError, match="Smoother: the belief after 1 of 6 steps depends on later observations"):
        forbes.evaluate(Smoother().eval(), DATA, ["elbo"], sequences=2)


@pytest.mark.parametrize("kind", [Right, Draws])
def test_a_right_adapter_passes(kind):
    check_model(kind().eval(), DATA, "mine")


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (Smoother, "the belief after 1 of 6 steps depends on later observations, expected those so far only"),
        (AttentionWithoutMask, "the belief after 1 of 6 steps depends on later observations"),
        (BatchNorm, "the belief .* depends on"),
        (OwnNoise, "gives other numbers for the same seed|is not that of advance"),
        (InPlace, "changes its arguments in place"),
        (WideBatchShape, r"prior returns a distribution of batch shape \(4, 3\) and event shape \(\), expected \(4,\)"),
        (NoDistribution, "prior returns a Tensor, expected a torch.distributions.Distribution"),
        (Tuples, r"initial returns a tuple, expected forbes.State\(hidden, state\)"),
        (NotFinite, "advance is not finite. The checkpoint is damaged, or the training diverged"),
        (OtherHidden, "the hidden state of predict is not that of advance, expected the same"),
        (FlatDecoder, r"decode_state has shape \(4,\), expected \(4, 1\)"),
        (NoLikelihood, "has no likelihood. Set it to what decode_state returns"),
        (Images, "its likelihood is one of observations with 3 dimensions, the data have 1"),
        (Swapped, r"the mean of p / q under q is e\^\d+, expected at most 1"),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_a_wrong_adapter_is_one_sentence(kind, sentence):
    with pytest.raises(ForbesError, match=f"^mine: .*{sentence}") as raised:
        check_model(kind().eval(), DATA, "mine")

    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("likelihood", "sentence"),
    [
        (Unnormalised(), r"its likelihood mse integrates to 1\.7\d*, expected 1. A constant is missing"),
        (
            OtherUnits(),
            r"is called normal\(0.707107\), but its target is in other units than that of forbes",
        ),
        (Normalised(), None),
    ],
)
def test_an_own_likelihood_is_normalised_and_in_units_of_the_data(likelihood, sentence):
    model = Right().eval()
    model.likelihood = likelihood

    if sentence is None:
        check_model(model, DATA, "mine")
    else:
        with pytest.raises(ForbesError, match=sentence):
            check_model(model, DATA, "mine")


class NoSampler(forbes.VectorNormal):
    def sample(self, output):
        raise NotImplementedError


def test_a_likelihood_without_a_sampler_is_refused_only_where_it_is_needed():
    model = Right().eval()
    model.likelihood = NoSampler()

    check_model(model, DATA, "mine")
    with pytest.raises(ForbesError, match="its likelihood has no sample, which is needed here"):
        check_model(model, DATA, "mine", needs=("sample", "mean"))


class Symbols(forbes.OneHot):
    """A softmax over all symbols, times a factor."""

    def __init__(self, factor):
        self.name, self.factor = "symbols", factor

    def log_prob(self, output, target):
        return super().log_prob(output, target) + math.log(self.factor)


@pytest.mark.parametrize("factor", [1, 1.5])
def test_an_own_likelihood_of_symbols_sums_to_one(factor):
    symbols = TIGER.observation_shape[0]
    model = Right().eval()
    model.likelihood = Symbols(factor)
    model.posterior_of, model.decoder = nn.Linear(5 + symbols, 3), nn.Linear(8, symbols)

    if factor == 1:
        check_model(model, TIGER, "mine")
    else:
        with pytest.raises(ForbesError, match=r"its likelihood symbols integrates to 1.5, expected 1"):
            check_model(model, TIGER, "mine")


def test_a_discrete_state_passes_with_its_distribution_of_another_shape():
    class Discrete(Right):
        def distribution(self, logits):
            return Independent(OneHotCategorical(logits=logits.unflatten(-1, (1, 3))), 1)

        def prior(self, hidden):
            return self.distribution(self.prior_of(hidden))

        def posterior(self, hidden, embedding):
            return self.distribution(self.posterior_of(torch.cat((hidden, embedding), -1)))

    check_model(Discrete().eval(), DATA, "mine")
