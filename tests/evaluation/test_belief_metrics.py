"""The scores as torchmetrics: their definitions, any split of the data, several devices, and a LightningModule."""

import math
import warnings

import pytest
import torch
from lightning import LightningModule, Trainer
from torch.distributions import Normal
from torch.utils.data import DataLoader

import forbes
from forbes.errors import ForbesError
from forbes.evaluation.calibration.ranks import coverage, ranks

SAMPLES, SEQUENCES, STEPS = 5, 7, 4


def inputs(name):
    """A metric, and the arguments of `update` for some sequences; the dimension of each that counts them."""
    generator = torch.Generator().manual_seed(1)
    mask = torch.arange(STEPS) < torch.randint(1, STEPS + 1, (SEQUENCES, 1), generator=generator)  # (B, T)
    draw = torch.randn(SAMPLES + 1, SEQUENCES, STEPS, generator=generator)
    return {
        "elbo": (forbes.ELBO, (draw[0], draw[1], mask), (0, 0, 0)),
        "pll": (forbes.PLL, (draw, mask), (1, 0)),
        "calibration": (
            lambda **options: forbes.CalibrationError(SAMPLES, **options),
            (draw[0, :, 0], draw[1:, :, 0]),
            (0, 1),
        ),
    }[name]


def parts(arguments, dims, cut=3):
    """Both parts of a batch that is cut after some sequences."""
    pairs = [
        (values.narrow(dim, 0, cut), values.narrow(dim, cut, SEQUENCES - cut))
        for values, dim in zip(arguments, dims, strict=True)
    ]
    return zip(*pairs, strict=True)


metrics = pytest.mark.parametrize("name", ["elbo", "pll", "calibration"])


def test_the_elbo_is_the_mean_of_the_sums_over_steps_that_count():
    kind, (log_likelihood, kl, mask), _ = inputs("elbo")
    metric = kind()

    metric.update(log_likelihood, kl, mask)

    sums = [
        sum(log_likelihood[n, t].double() - kl[n, t].double() for t in range(STEPS) if mask[n, t])
        for n in range(SEQUENCES)
    ]
    torch.testing.assert_close(metric.compute(), torch.stack(sums).mean())


def test_the_pll_averages_probabilities_and_not_logarithms():
    kind, (log_prob, mask), _ = inputs("pll")
    metric = kind()

    metric.update(log_prob, mask)

    probability = log_prob.double().exp().mean(0)  # (B, T)
    torch.testing.assert_close(metric.compute(), (probability.log() * mask).sum() / SEQUENCES)


def test_the_calibration_error_is_the_area_between_coverage_and_level():
    generator = torch.Generator().manual_seed(0)
    truth, drawn = torch.randn(300, generator=generator), 0.7 * torch.randn(19, 300, generator=generator)
    belief, metric = Normal(0, 0.7), forbes.CalibrationError(19)

    metric.update(belief.log_prob(truth), belief.log_prob(drawn))

    rank = ranks(belief.log_prob(truth), belief.log_prob(drawn), generator)
    level = (torch.arange(100, dtype=torch.float64) + 0.5) / 100
    torch.testing.assert_close(metric.compute(), (coverage(rank, 19, level) - level).abs().mean())


def test_the_calibration_error_has_its_limits():
    """States outside of every region: coverage 0. States at the mode: coverage 1, but for the first of L + 1 steps."""
    for state in (-1.0, 1.0):
        metric = forbes.CalibrationError(99)
        metric.update(torch.full((50,), state), torch.zeros(99, 50))

        assert metric.compute() == pytest.approx(0.5 - 0.5 / 100)


def test_a_belief_that_cannot_tell_anything_is_calibrated():
    """A uniform q has the same density everywhere: all ranks are ties, and no error is left."""
    metric = forbes.CalibrationError(9)
    metric.update(torch.zeros(4), torch.zeros(9, 4))

    torch.testing.assert_close(metric.compute(), torch.zeros((), dtype=torch.float64))


@pytest.mark.parametrize(("width", "found"), [(1.0, False), (0.8, True), (1.25, True)])
def test_wrong_widths_are_found_and_the_right_one_is_not(width, found):
    """N pairs of a calibrated belief give sqrt(2 / pi) pi / 8 / sqrt(N) on average; four times that is an alarm."""
    count, generator = 2000, torch.Generator().manual_seed(0)
    state, drawn = torch.randn(count, generator=generator), torch.randn(99, count, generator=generator)
    belief, metric = Normal(0, width), forbes.CalibrationError(99)

    metric.update(belief.log_prob(state), belief.log_prob(width * drawn))

    alarm = 4 * math.sqrt(2 / math.pi) * math.pi / 8 / math.sqrt(count)
    assert (metric.compute() > alarm) == found


@metrics
def test_two_halves_are_the_whole(name):
    kind, arguments, dims = inputs(name)
    whole, halves = kind(), kind()

    whole.update(*arguments)
    for part in parts(arguments, dims):
        halves.update(*part)

    torch.testing.assert_close(halves.compute(), whole.compute())


@metrics
def test_two_devices_are_the_whole(name):
    """torchmetrics gathers each state from all processes; here the second process is another metric."""
    kind, arguments, dims = inputs(name)
    whole, other = kind(), kind()
    whole.update(*arguments)
    first, second = parts(arguments, dims)
    other.update(*second)
    states = iter(other.metric_state.values())  # in the order in which they are gathered
    mine = kind(dist_sync_fn=lambda state, group: [state, next(states)], distributed_available_fn=lambda: True)

    mine.update(*first)

    torch.testing.assert_close(mine.compute(), whole.compute())


@metrics
def test_states_stay_float64_for_float32_inputs_and_modules(name):
    """States are float64 for any input, and a conversion of the module to float32 leaves them so."""
    kind, arguments, _ = inputs(name)
    metric = torch.nn.ModuleList([kind()]).float()[0]

    metric.update(*arguments)

    assert all(state.dtype == torch.float64 for state in metric.metric_state.values())
    assert metric.compute().dtype == torch.float64


def test_padding_may_have_any_value():
    for padding in (math.inf, math.nan, -math.inf):
        metric = forbes.ELBO()
        metric.update(torch.tensor([[-1.0, padding]]), torch.tensor([[0.5, 0.0]]), torch.tensor([[True, False]]))

        assert metric.compute() == -1.5


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: forbes.ELBO().update(torch.zeros(2, 3), torch.zeros(2, 3), torch.ones(2).bool()), r"ELBO: .* \(2,\)"),
        (lambda: forbes.PLL().update(torch.zeros(2, 3), torch.ones(2, 3).bool()), r"PLL: the values have shape \(3,\)"),
        (lambda: forbes.CalibrationError(0), "CalibrationError: samples is 0, expected at least 1"),
        (lambda: forbes.CalibrationError(3).update(torch.zeros(2), torch.zeros(2, 2)), r"expected \(N,\) and \(3, N\)"),
        (lambda: forbes.CalibrationError(1).update(torch.tensor([math.nan]), torch.zeros(1, 1)), "is NaN"),
    ],
)
def test_wrong_inputs_are_one_sentence(call, sentence):
    with pytest.raises(ForbesError, match=sentence):
        call()


class Anyones(LightningModule):
    """A module that has nothing of this package but the metric."""

    def __init__(self):
        super().__init__()
        self.elbo = forbes.ELBO()

    def validation_step(self, batch, index):
        self.elbo.update(batch, torch.zeros_like(batch), torch.ones_like(batch).bool())
        self.log("val/elbo", self.elbo)


def test_any_lightning_module_logs_it_for_batches_of_any_size():
    values = torch.arange(10.0).view(5, 2)
    trainer = Trainer(accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False)

    with warnings.catch_warnings():  # Lightning's, of data that need no workers
        warnings.simplefilter("ignore")
        (found,) = trainer.validate(Anyones(), DataLoader(values, batch_size=3), verbose=False)

    assert found["val/elbo"] == values.sum(1).mean()
