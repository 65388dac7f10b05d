"""The LightningModule: what it optimises, what it logs, and that its noise depends on seed and update only."""

import math
from functools import partial

import pytest
import torch
from batches import batch_of
from lightning import LightningDataModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch.utils.data import DataLoader

from forbes.beliefs import CategoricalBelief, FlowBelief, GaussianBelief
from forbes.commands.cli import main
from forbes.errors import ForbesError
from forbes.models import (
    Bernoulli,
    MLPDecoder,
    MLPEncoder,
    Normal,
    OneHot,
    ParticleModel,
    VectorModel,
    VectorNormal,
    elbo_loss,
)
from forbes.seeding import derive_seed
from forbes.training import WorldModel

# Lightning 2.6 uses what torch 2.13 deprecates, and has its opinion on loaders without workers.
pytestmark = [pytest.mark.filterwarnings(f"ignore:.*{text}") for text in ("LeafSpec", "does not have many workers")]

BATCH, TIME, SHAPE = 4, 5, (1, 4, 4)
BOUND = "elbo[bernoulli,S=1]"


def make_world_model(**options):
    torch.manual_seed(0)
    defaults = {
        "belief": partial(FlowBelief, layers=2, width=4),
        "encoder": partial(MLPEncoder, width=8, layers=1),
        "decoder": partial(MLPDecoder, width=8, layers=1),
        "likelihood": Bernoulli(),
        "observation_shape": SHAPE,
        "action_dim": 1,
        "state_dim": 2,
        "hidden_dim": 6,
        "mlp_dim": 8,
        "mlp_layers": 1,
        "free_nats": 0.0,
    }
    return WorldModel(**{**defaults, **options})


def make_batch(seed=0, batch=BATCH):
    generator = torch.Generator().manual_seed(seed)
    mask = torch.ones(batch, TIME, dtype=torch.bool)
    mask[0, 3:] = False
    observation = torch.randint(2, (batch, TIME, *SHAPE), generator=generator, dtype=torch.uint8)
    return batch_of(observation, torch.rand(batch, TIME, 1, generator=generator), mask=mask)


class Batches(LightningDataModule):
    """The same batch again and again; two batches of different sizes for validation."""

    def __init__(self, updates):
        super().__init__()
        self.updates = updates

    def train_dataloader(self):
        return DataLoader([make_batch()] * self.updates, batch_size=None)

    def val_dataloader(self):
        return DataLoader([make_batch(1), make_batch(2, batch=1)], batch_size=None)

    test_dataloader = predict_dataloader = val_dataloader


def rate(trainer):
    [group] = trainer.optimizers[0].param_groups
    return group["lr"]


class Recorder(Callback):
    """What each update logged, its loss, and the learning rate and the norm of the gradients it used."""

    def __init__(self):
        self.rows, self.rates = [], []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.rates.append(rate(trainer))

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        metrics = {name: value.item() for name, value in trainer.callback_metrics.items()}
        norm = torch.stack([p.grad.norm() for p in pl_module.parameters() if p.grad is not None]).norm()
        self.rows.append({**metrics, "loss": outputs["loss"].item(), "used_norm": norm.item()})


def fit(model, updates=3):
    recorder = Recorder()
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=1,
        callbacks=[recorder],
    )
    trainer.fit(model, Batches(updates))
    return trainer, recorder


def terms_of_first_update(model):
    """The bound's parts on the batch with the weights the model starts from and the noise of update 0."""
    model.on_train_batch_start(make_batch(), 0)
    return model.terms(make_batch())


@pytest.mark.parametrize(
    ("options", "loss"),
    [
        ({}, elbo_loss),
        ({"free_nats": 9.0}, lambda terms: elbo_loss(terms, 9.0)),
        (
            {"belief": GaussianBelief, "free_nats": 0.5, "free_nats_per": "element"},
            lambda terms: elbo_loss(terms, 0.5, "element"),
        ),
        ({"belief": GaussianBelief}, elbo_loss),
        ({"belief": GaussianBelief, "kl": "monte_carlo"}, lambda terms: elbo_loss(terms._replace(analytic_kl=None))),
        ({"kl_warmup": 10}, lambda terms: elbo_loss(terms, kl_weight=0.1)),
    ],
    ids=["plain", "free nats", "free nats per element", "closed form", "monte carlo", "warm-up"],
)
def test_the_loss_is_the_bound_with_the_options_asked_for(options, loss):
    _, recorder = fit(make_world_model(**options), updates=1)

    expected = loss(terms_of_first_update(make_world_model(**options)))

    assert recorder.rows[0]["loss"] == pytest.approx(expected.item())


def test_logged_bound_has_no_free_nats_weights_or_closed_forms():
    options = {"belief": GaussianBelief, "free_nats": 9.0, "kl_warmup": 10}
    _, recorder = fit(make_world_model(**options), updates=1)

    terms = terms_of_first_update(make_world_model(**options))

    logged = recorder.rows[0]
    assert logged[f"train/{BOUND}"] == pytest.approx(terms.elbo.mean().item())
    assert logged["train/kl"] == pytest.approx((terms.kl * terms.mask).sum().item() / BATCH)
    assert logged["train/reconstruction"] - logged["train/kl"] == pytest.approx(logged[f"train/{BOUND}"])


@pytest.mark.parametrize(
    ("options", "bound", "parts"),
    [
        ({"model": partial(ParticleModel, particles=3)}, "fivo[bernoulli,K=3]", {"reconstruction", "kl"}),
        ({"model": partial(VectorModel, overshoot=2), "state_dim": 0}, "log_p[bernoulli]", {"overshoot"}),
    ],
    ids=["particles", "vector"],
)
def test_a_model_with_another_filter_is_trained_by_its_own_bound(options, bound, parts):
    trainer, recorder = fit(make_world_model(**options), updates=1)

    terms = terms_of_first_update(make_world_model(**options))

    logged = recorder.rows[0]
    assert logged["loss"] == pytest.approx(elbo_loss(terms).item())
    assert logged[f"train/{bound}"] == pytest.approx(terms.elbo.mean().item())
    of_train = {name.removeprefix("train/") for name in logged if name.startswith("train/")}
    assert of_train == {bound, "gradient_norm_model"} | parts
    assert {f"val/{name}" for name in {bound} | parts} <= set(trainer.callback_metrics)
    if "overshoot" in parts:
        assert logged["loss"] == pytest.approx(
            -terms.elbo.sum().item() / terms.mask.sum().item() + logged["train/overshoot"]
        )


def mean_frame(batch):
    return batch.observation[batch.mask].double().mean(0).float() - 0.5  # (*O)


def test_a_centered_model_is_a_plain_one_of_centered_frames():
    """The density of a Gaussian moves with its mean; the first layer's bias takes up what the encoder is not shown."""
    options, batch = {"likelihood": Normal(scale=1)}, make_batch()
    centered, plain = make_world_model(**options, center=True), make_world_model(**options)
    centered.model.center.copy_(mean_frame(batch))
    with torch.no_grad():
        first, last = plain.model.encoder.net[0][0], plain.model.decoder.net[-1]
        first.bias -= first.weight @ mean_frame(batch).flatten()
        last.bias += mean_frame(batch).flatten()

    ours, theirs = (make_elbo(module, batch) for module in (centered, plain))

    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)  # float32 over 80 pixels


def make_elbo(module, batch):
    torch.manual_seed(0)
    return module.terms(batch).elbo


def test_the_mean_frame_is_that_of_the_first_batch_and_stays():
    module = make_world_model(likelihood=Normal(scale=1), center=True)

    fit(module, updates=3)

    torch.testing.assert_close(module.model.center, mean_frame(make_batch()))
    assert "model.center" in module.state_dict()
    assert "model.center" not in make_world_model().state_dict()


def test_logits_have_no_mean_frame():
    with pytest.raises(ForbesError, match="center with the likelihood Bernoulli, expected Normal or VectorNormal"):
        make_world_model(center=True)


@pytest.mark.parametrize(
    ("likelihood", "shape", "sentence"),
    [
        (
            Normal(),
            (5,),
            r"Normal is of .* rank 3, found .* \(5,\)\. Choose VectorNormal or OneHot as model.likelihood",
        ),
        (Bernoulli(), (5,), r"Bernoulli is of .* rank 3"),
        (VectorNormal(), (3, 64, 64), r"VectorNormal is of .* rank 1, .* \(3, 64, 64\)\. Choose Normal or Bernoulli"),
        (OneHot(), (4, 5), r"OneHot is of .* rank 1, .* Choose your own"),
    ],
)
def test_a_likelihood_that_would_sum_over_sequences_is_refused(likelihood, shape, sentence):
    """It would be a number for the whole batch, and train without a word."""
    with pytest.raises(ForbesError, match=sentence):
        WorldModel(encoder=MLPEncoder, decoder=MLPDecoder, likelihood=likelihood, observation_shape=shape)


def test_the_weight_of_the_divergence_rises_to_one():
    """With the learning rate at 0 the loss changes by the weight and the noise only; free nats fix the divergence."""
    _, recorder = fit(make_world_model(learning_rate=0.0, kl_warmup=4, free_nats=50.0), updates=6)
    _, without = fit(make_world_model(learning_rate=0.0, free_nats=50.0), updates=6)

    missing = [full["loss"] - row["loss"] for full, row in zip(without.rows, recorder.rows, strict=True)]

    assert missing == pytest.approx([37.5, 25, 12.5, 0, 0, 0], abs=1e-4)


def test_noise_depends_on_seed_and_update_only():
    def losses(model):
        return [row["loss"] for row in fit(model)[1].rows]

    first = losses(make_world_model(learning_rate=0.0))
    torch.manual_seed(123)

    assert losses(make_world_model(learning_rate=0.0)) == first
    assert losses(make_world_model(learning_rate=0.0, seed=1)) != first
    assert len(set(first)) == 3


def test_validation_has_fixed_noise_and_equal_sequence_weights():
    trainer, _ = fit(make_world_model(learning_rate=0.0), updates=1)
    name, model = f"val/{BOUND}", trainer.lightning_module
    in_training = trainer.callback_metrics[name].item()

    [again] = trainer.validate(model, Batches(1), verbose=False)
    each = []
    for number, batch in enumerate((make_batch(1), make_batch(2, batch=1))):
        torch.manual_seed(derive_seed(model.seed, "validation", number))
        with torch.no_grad():
            each += model.terms(batch).elbo.tolist()

    assert again[name] == in_training
    assert in_training == pytest.approx(sum(each) / len(each))  # of five sequences, not of two batches


def test_test_and_prediction_give_the_bound_of_each_sequence():
    trainer, _ = fit(make_world_model(), updates=1)

    [logged] = trainer.test(trainer.lightning_module, Batches(1), verbose=False)
    predicted = trainer.predict(trainer.lightning_module, Batches(1))

    assert set(logged) == {f"test/{BOUND}", "test/reconstruction", "test/kl"}
    assert [elbo.shape for elbo in predicted] == [(BATCH,), (1,)]


def test_gradients_are_clipped_and_the_norm_before_is_logged():
    free, clipped = (fit(make_world_model(clip_norm=norm), updates=1)[1].rows[0] for norm in (1e6, 0.1))

    assert free["used_norm"] > 0.1
    assert clipped["used_norm"] == pytest.approx(0.1, rel=1e-4)
    assert clipped["train/gradient_norm_model"] == pytest.approx(free["used_norm"], rel=1e-5)


def test_adam_has_the_papers_settings_and_every_parameter():
    trainer, _ = fit(make_world_model(), updates=1)
    [optimizer], model = trainer.optimizers, trainer.lightning_module
    [group] = optimizer.param_groups

    assert (group["lr"], group["eps"], group["betas"], group["weight_decay"]) == (5e-4, 1e-7, (0.9, 0.999), 0)
    assert {id(p) for p in group["params"]} == {id(p) for p in model.parameters()}


@pytest.mark.parametrize(
    ("options", "rates"),
    [
        ({}, [1, 1, 1, 1]),
        ({"warmup": 3}, [1 / 3, 2 / 3, 1, 1]),
        ({"schedule": "cosine"}, [0.5 * (1 + math.cos(math.pi * update / 4)) for update in range(4)]),
        ({"schedule": "cosine", "warmup": 2}, [0.5, *(0.5 * (1 + math.cos(math.pi * u / 4)) for u in (1, 2, 3))]),
    ],
    ids=["constant", "warm-up", "cosine", "both"],
)
def test_each_update_has_the_learning_rate_of_the_schedule(options, rates):
    trainer, recorder = fit(make_world_model(learning_rate=0.01, **options), updates=4)

    assert recorder.rates == pytest.approx([0.01 * share for share in rates])
    if "schedule" in options:
        assert rate(trainer) == 0  # after the last update


def test_a_cosine_needs_an_end():
    endless = Trainer(accelerator="cpu", max_epochs=-1, logger=False, enable_checkpointing=False)

    with pytest.raises(ForbesError, match=r"a cosine to 0 at the last update, which this training does not have\. Set"):
        endless.fit(make_world_model(schedule="cosine"), Batches(1))


def test_an_update_changes_every_parameter_sooner_or_later():
    model = make_world_model()
    before = {name: p.detach().clone() for name, p in model.named_parameters()}

    fit(model, updates=3)

    assert [name for name, p in model.named_parameters() if torch.equal(p, before[name])] == []


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"belief": partial(CategoricalBelief, classes=2)}, "draws of a CategoricalBelief are not reparameterised"),
        ({"model": VectorModel, "state_dim": 0}, "kl is path for a VectorModel, expected analytic"),
    ],
)
def test_a_path_derivative_that_does_not_exist_is_refused(flags, message):
    with pytest.raises(ForbesError, match=message):
        make_world_model(kl="path", **flags)


ONE_HOT = partial(CategoricalBelief, classes=2)
BALANCED = partial(CategoricalBelief, classes=2, kl_balance=0.8)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"belief": GaussianBelief, "prior": ONE_HOT}, "are real vectors, those of the prior one-hot variables"),
        ({"belief": ONE_HOT, "prior": GaussianBelief}, "one-hot variables of 2 classes, those of the prior real"),
        ({"belief": ONE_HOT, "prior": partial(CategoricalBelief, classes=4)}, "of the prior one-hot variables of 4"),
        ({"kl": "exact"}, "kl is 'exact', expected analytic or monte_carlo or path"),
        ({"free_nats_per": "digit"}, "free_nats_per is 'digit', expected batch or element"),
        ({"schedule": "linear"}, "schedule is 'linear', expected constant or cosine"),
        ({"activation": "gelu"}, "activation is 'gelu', expected relu"),
        ({"warmup": -3}, "warmup is -3, expected at least 0"),
        ({"kl_warmup": -5}, "kl_warmup is -5, expected at least 0"),
        ({"free_nats": -1.0}, "free_nats is -1.0, expected at least 0"),
        ({"model": ParticleModel.configured(resampling="never")}, "resampling is 'never', expected systematic or soft"),
    ],
)
def test_options_that_do_not_fit_are_refused(flags, message):
    with pytest.raises(ForbesError, match=message):
        make_world_model(**{"state_dim": 4} | flags)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"free_nats_per": "element"}, "free_nats_per is element, but the KL is estimated by samples"),
        ({"free_nats_per": "element", "belief": GaussianBelief, "model": ParticleModel}, "estimated by samples"),
        ({"free_nats_per": "element", "belief": GaussianBelief, "kl": "path"}, "estimated by samples"),
        ({"belief": BALANCED, "kl": "monte_carlo"}, "kl_balance weighs the gradients of the KL in closed form"),
        ({"belief": BALANCED, "model": ParticleModel}, "kl_balance weighs the gradients of the KL in closed form"),
    ],
)
def test_a_loss_that_needs_a_closed_form_is_not_trained_without(flags, message):
    """A model that was trained with it can still be loaded."""
    model = make_world_model(**{"state_dim": 4} | flags)

    with pytest.raises(ForbesError, match=message):
        fit(model)


def test_particles_train_by_the_path_derivative():
    model = make_world_model(kl="path", belief=GaussianBelief, model=ParticleModel)
    before = [parameter.detach().clone() for parameter in model.model.posterior.parameters()]

    fit(model, updates=2)

    assert not any(map(torch.equal, before, model.model.posterior.parameters()))


def test_the_first_batch_must_have_a_density(tiny_config, tmp_path, capsys):
    flags = ["--model.likelihood", "OnePixel", "--data.source.points_per_step", "2"]

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run"), *flags]) == 2

    assert "OnePixel: a frame has 2 pixels that are on, expected at most 1" in capsys.readouterr().err
