"""The world model as a LightningModule: it optimises and logs; the mathematics is in `forbes.models`."""

import inspect
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeAlias, cast

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from forbes.beliefs import BeliefFamily, FlowBelief
from forbes.data import SequenceBatch, SequenceDataModule
from forbes.errors import ForbesError
from forbes.models.base import ModelFamily
from forbes.models.elbo import KL, ElboTerms, FreeNats, elbo_loss
from forbes.models.likelihoods import Likelihood, Normal
from forbes.models.networks import Activation, ConvDecoder, ConvEncoder, DecoderFamily, EncoderFamily, activate
from forbes.models.state_space import StateSpaceModel
from forbes.runs.hyperparameters import plain_arguments
from forbes.seeding import derive_seed
from forbes.signatures import full_signature
from forbes.training.defaults import defaults_for
from forbes.training.divergence import hold_unless_finite
from forbes.training.requirements import require_mean, require_path, require_rank

__all__ = ["Group", "Objective", "WorldModel", "batches_before", "follow_rates", "require_at_least", "together"]


class Group(NamedTuple):
    """Parameters that share a learning rate, and whose gradients are clipped together."""

    name: str
    parameters: list[nn.Parameter]
    rate: float


Objective: TypeAlias = Callable[[], tuple[Tensor, dict[str, Tensor]]]
"""Gives a loss, and what is logged of it: by name, detached."""


class WorldModel(LightningModule):
    """Learns a belief state model of sequences by a bound (paper §3.1). Defaults are the paper's for DeepMind Control.

    Args:
        belief: the family of prior and posterior, a class of `forbes.beliefs` with its own arguments.
        prior: the family of the prior, where it is another one: a flow in only one of the two.
        model: how it filters, a class of `forbes.models` with its own arguments: `StateSpaceModel`, `ParticleModel`
            (the belief is a set of particles) or `VectorModel` (no stochastic state).
        encoder: o_t to e_t, a class of `forbes.models.networks`.
        decoder: features to the likelihood's parameters, likewise.
        likelihood: what the decoder's output means; `Normal()` by default.
        observation_shape: of one observation; the command line takes it from the data.
        action_dim: A; likewise.
        state_dim: D of s; 0 for a `VectorModel`.
        hidden_dim: H of the GRU.
        mlp_dim: width of every perceptron.
        mlp_layers: layers of every perceptron.
        activation: of every perceptron; convolutions and flows keep their ReLU.
        kl: how the KL is differentiated. "analytic" by its closed form where the family has one, else as "path": at the
            posterior's sample, through the sample alone; "monte_carlo" through the posterior's parameters too, a noise
            that costs a flow thousands of updates.
        free_nats: the KL below this, in nats per step, costs nothing in training.
        free_nats_per: "batch" applies them to the mean over batch and time, "element" to each step.
        kl_warmup: updates over which the weight of the KL rises from 0 to 1.
        learning_rate: of Adam (eps 1e-7).
        schedule: "constant", or "cosine" to 0 at the end of the training.
        warmup: updates over which the learning rate rises from 0; a high rate needs it.
        clip_norm: gradients are scaled down to this norm.
        center: measure the mean observation on the first batch; encoder and decoder then see what differs from it. The
            same models, found several times faster where most of a frame never changes; for Gaussian likelihoods.
        seed: of the noise of training and validation.

    Raises:
        ForbesError: when a size is below 1, the learning rate or `clip_norm` below 0, or `likelihood` or `center` does
            not fit.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> world = forbes.WorldModel.for_data(data, belief=forbes.FlowBelief.configured(layers=3))
        >>> batch = data.sequences("test", torch.arange(8))
        >>> world.terms(batch).elbo.shape  # train it with Trainer().fit(world, data)
        torch.Size([8])
    """

    def __init__(
        self,
        belief: BeliefFamily = FlowBelief,
        prior: BeliefFamily | None = None,
        model: ModelFamily = StateSpaceModel,
        encoder: EncoderFamily = ConvEncoder,
        decoder: DecoderFamily = ConvDecoder,
        likelihood: Likelihood | None = None,
        observation_shape: tuple[int, ...] = (3, 64, 64),
        action_dim: int = 0,
        state_dim: int = 30,
        hidden_dim: int = 200,
        mlp_dim: int = 200,
        mlp_layers: int = 2,
        activation: Activation = "relu",
        kl: KL = "analytic",
        free_nats: float = 3.0,
        free_nats_per: FreeNats = "batch",
        kl_warmup: int = 0,
        learning_rate: float = 5e-4,
        schedule: Literal["constant", "cosine"] = "constant",
        warmup: int = 0,
        clip_norm: float = 100.0,
        center: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_at_least(1, "WorldModel", hidden_dim=hidden_dim, mlp_dim=mlp_dim, mlp_layers=mlp_layers)
        require_at_least(0, "WorldModel", state_dim=state_dim, learning_rate=learning_rate, clip_norm=clip_norm)
        likelihood = likelihood or Normal()
        require_rank(likelihood, observation_shape)
        self.model = model(
            belief,
            encoder(observation_shape),
            decoder(hidden_dim + state_dim, observation_shape),
            likelihood,
            action_dim,
            state_dim,
            hidden_dim,
            mlp_dim,
            mlp_layers,
            prior,
        )
        require_path(kl, self.model)
        self.activation: Activation = activation
        activate(self.model, activation)
        if center:
            require_mean(likelihood)
            self.model.center = torch.zeros(observation_shape)
        self.kl, self.free_nats, self.free_nats_per, self.kl_warmup = kl, free_nats, free_nats_per, kl_warmup
        self.learning_rate, self.schedule, self.warmup = learning_rate, schedule, warmup
        self.clip_norm, self.seed = clip_norm, seed

    __signature__: ClassVar[inspect.Signature]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Show the arguments of `WorldModel` in the signature of every class that derives from it, too."""
        super().__init_subclass__(**kwargs)
        cls.__signature__ = full_signature(cls)

    @classmethod
    def for_data(cls, data: SequenceDataModule, **options: Any) -> Self:
        """Build a model for these data: their shapes and seed, and networks and a likelihood that fit them.

        Args:
            data: with the source that the model is to learn.
            **options: arguments of the constructor by name. What is not given is as in `configs/` for such data (see
                `defaults_for`).
        """
        of_data = {"observation_shape": data.observation_shape, "action_dim": data.action_dim, "seed": data.seed}
        arguments: dict[str, Any] = of_data | defaults_for(data.source) | options
        model = cls(**arguments)
        model.save_hyperparameters(plain_arguments(arguments))  # for `load_from_checkpoint`
        return model

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]  # without what would unpickle
        cls, checkpoint_path: Path | str, map_location: torch.device | str = "cpu", **arguments: Any
    ) -> Self:
        """Load a trained model. Only tensors and plain values are read, and nothing is unpickled.

        Args:
            checkpoint_path: a checkpoint of a run folder, whose config.yaml has the arguments of the model, or one that
                a plain `Trainer` saved, which has those itself if the model was built by `for_data`.
            map_location: device of the loaded model.
            **arguments: arguments of the constructor that replace those the model was trained with. For a run folder
                they are plain values, as in config.yaml.

        Returns:
            The model in training mode; call `eval()` to measure it.

        Raises:
            ForbesError: where the checkpoint is damaged, of another class, or does not fit the arguments.
        """
        from forbes.runs.modules import load_module  # it imports the models

        return load_module(Path(checkpoint_path), cls, arguments).train().to(map_location)

    @property
    def objective_name(self) -> str:
        """Name the metric, without its split, that says how the training goes."""
        return self.model.bound_name

    def terms(self, batch: SequenceBatch) -> ElboTerms:
        """Estimate the parts of the bound on a batch."""
        return self.model.lower_bound(batch.observation, batch.action, batch.mask, self.kl)

    def on_train_batch_start(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Seed the noise of this batch, so that a resumed run draws the same; check an epoch's first observations."""
        if batch_idx == 0:
            self.model.likelihood.check(batch.observation)
        number = batches_before(self)
        torch.manual_seed(derive_seed(self.seed, "update", number))
        if self.model.center is not None and number == 0:
            self.model.center.copy_(self.model.likelihood.target(batch.observation)[batch.mask].mean(0))  # (*O)

    def training_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Return the loss of one update, and log what `losses` gives besides."""
        loss, values = self.losses(batch)
        self._log("train", values, batch)
        return loss

    def losses(self, batch: SequenceBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of one update, the sum of all objectives, and what is logged of it: by name, detached."""
        return together([objective() for objective in self.objectives(batch)])

    def objectives(self, batch: SequenceBatch) -> list[Objective]:
        """Compute what the objectives of an update share, and give them: none depends on another.

        They depend on batch, parameters and noise alone, so that `CudaGraph` can record them.
        """
        terms = self.terms(batch)
        return [lambda: (self.loss(terms), self.measures(terms))]

    def loss(self, terms: ElboTerms) -> Tensor:
        """Return the loss of this update in nats per step, a scalar."""
        weight = min(1.0, (self.global_step + 1) / self.kl_warmup) if self.kl_warmup else 1.0
        return elbo_loss(terms, self.free_nats, self.free_nats_per, weight)

    def on_validation_epoch_start(self) -> None:
        """Seed the noise of a validation, the same each time."""
        torch.manual_seed(derive_seed(self.seed, "validation", 0))

    def validation_step(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Log the bound of the validation split with one sample."""
        self._log("val", self.measures(self.terms(batch)), batch)

    def test_step(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Log the bound of the test split with one sample; `forbes evaluate` is the careful way."""
        self._log("test", self.measures(self.terms(batch)), batch)

    def predict_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Return the bound of each sequence in nats, `(B,)`, with one sample."""
        return self.terms(batch).elbo

    def groups(self) -> list[Group]:
        """Say which parameters share a learning rate and are clipped together."""
        return [Group("model", [*self.parameters()], self.learning_rate)]

    def configure_optimizers(self) -> Any:
        """Adam with the paper's rate; fused, since a step over many small tensors is bound by calls."""
        groups = [{"params": group.parameters, "lr": group.rate} for group in self.groups()]
        optimizer = Adam(groups, eps=1e-7, fused=True)
        scheduler = LambdaLR(optimizer, self._rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_train_start(self) -> None:
        """Learn at the rates of the configuration, which a resumed run may have changed."""
        follow_rates(self, [group.rate for group in self.groups()])

    def _rate(self, update: int) -> float:
        """Return the learning rate of an update as a share of `learning_rate`."""
        rise = min(1.0, (update + 1) / self.warmup) if self.warmup else 1.0
        if self.schedule == "constant":
            return rise
        done = min(1.0, update / self.trainer.estimated_stepping_batches)
        return rise * 0.5 * (1 + math.cos(math.pi * done))

    def configure_gradient_clipping(
        self, optimizer: Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip each group to `clip_norm` and log the norm before; make no step where a norm is not finite."""
        for group in self.groups():
            norm = torch.nn.utils.clip_grad_norm_(group.parameters, self.clip_norm, foreach=True)
            self.log(f"train/gradient_norm_{group.name}", norm)
            hold_unless_finite(optimizer, norm, self.global_step)

    def measures(self, terms: ElboTerms) -> dict[str, Tensor]:
        """Return means in nats per sequence, auxiliary losses per step: the bound without free nats, and its parts."""
        parts = {
            "reconstruction": (terms.reconstruction * terms.mask).sum(1).mean(),
            "kl": (terms.kl * terms.mask).sum(1).mean(),
            **terms.auxiliary,
        }
        values = {self.objective_name: terms.elbo.mean()} | {name: parts[name] for name in self.model.parts}
        return {name: value.detach() for name, value in values.items()}

    def _log(self, split: str, values: dict[str, Tensor], batch: SequenceBatch) -> None:
        self.log_dict({f"{split}/{name}": value for name, value in values.items()}, batch_size=len(batch.mask))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what `CudaGraph` has put in the place of `losses`: it belongs to one process."""
        return {name: value for name, value in super().__getstate__().items() if name != "losses"}


def together(found: Sequence[tuple[Tensor, dict[str, Tensor]]]) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the sum of the losses that objectives have found, and all that is logged of them."""
    (first, _), *others = found
    loss = sum((loss for loss, _ in others), first)
    return loss, {name: value for _, values in found for name, value in values.items()}


def batches_before(module: LightningModule) -> int:
    """Return how many training batches came before the one at hand; they are updates unless gradients accumulate."""
    trainer = module._trainer
    return 0 if trainer is None else trainer.fit_loop.total_batch_idx


def follow_rates(module: LightningModule, rates: Sequence[float]) -> None:
    """Set the learning rates of a module's one `LambdaLR`, a rate each group: a checkpoint brings back its own."""
    scheduler = cast(LambdaLR, module.lr_schedulers())
    scheduler.base_lrs = [*rates]
    for group, rate, share in zip(scheduler.optimizer.param_groups, rates, scheduler.lr_lambdas, strict=True):
        group["lr"] = rate * share(scheduler.last_epoch)


def require_at_least(least: float, where: str, **numbers: Any) -> None:
    """Raise a ForbesError for the first number that is below `least`, or none at all."""
    for name, number in numbers.items():
        if number is None or not number >= least:  # a configuration can say null
            raise ForbesError(f"{where}: {name} is {number}, expected at least {least}")
