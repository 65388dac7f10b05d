"""The world model as a LightningModule: it optimises and logs; the mathematics is in `forbes.models`."""

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor
from torch.optim import Optimizer

from forbes.data import SequenceBatch, SequenceDataModule
from forbes.distributed import means_over_ranks, shared_batch, sum_over_ranks
from forbes.models.elbo import ElboTerms, elbo_loss
from forbes.models.requirements import require_closed_form
from forbes.models.world import World
from forbes.runs.hyperparameters import plain_arguments
from forbes.runs.modules import load_module
from forbes.signatures import full_signature
from forbes.training.defaults import defaults_for
from forbes.training.seeded import SeededModule

__all__ = ["LossTerm", "WorldModel", "sum_of_terms"]


class LossTerm(NamedTuple):
    """A part of the loss of an update."""

    loss: Tensor
    """A scalar with a gradient."""
    logs: dict[str, Tensor]
    """What is logged with it: scalars by name, without a gradient."""


class WorldModel(World, SeededModule):
    """Learns a belief state model of sequences by a bound (paper §3.1). Defaults are the paper's for DeepMind Control.

    Args:
        belief: the family of prior and posterior, a class of `forbes.beliefs` with its own arguments.
        prior: the family of the prior, where it is another one: a flow in only one of the two.
        model: how it filters, a class of `forbes.models` with its own arguments: `StateSpaceModel`, `ParticleModel`
            (the belief is a set of particles) or `VectorModel` (no stochastic state).
        encoder: o_t to e_t, a class of `forbes.models.networks`.
        decoder: features to the likelihood's parameters, likewise.
        likelihood: what the decoder's output means; `Normal()` by default.
        observation_shape: shape of one observation, or of its parts by name; the command line takes it from the data.
        action_dim: dimensions of an action, A; the command line takes it from the data.
        state_dim: dimensions of s, D; 0 for a `VectorModel`.
        hidden_dim: dimensions of h, the GRU's state, H.
        mlp_dim: width of every MLP.
        mlp_layers: layers of every MLP.
        activation: activation of every MLP; convolutions and flows keep their ReLU.
        kl: how the KL is differentiated. "analytic": by its closed form where the family has one, else as "path".
            "path": at the posterior's sample, through the sample alone. "monte_carlo": through the posterior's
            parameters too; this noise costs a flow thousands of updates. Of a `ParticleModel`, "analytic" is this.
        free_nats: the KL below this, in nats per step, costs nothing in training.
        free_nats_per: "batch" applies them to the mean over batch and time, "element" to each step, for a KL in closed
            form.
        kl_warmup: updates over which the weight of the KL rises from 0 to 1.
        learning_rate: learning rate of Adam (eps 1e-7).
        schedule: "constant", or "cosine" to 0 at the end of the training.
        warmup: updates over which the learning rate rises from 0; a high rate needs it.
        clip_norm: gradients are scaled down to this norm.
        center: measure the mean observation on the first batch. Encoder and decoder then work on the difference to it.
            This learns several times faster where most of a frame never changes. For Gaussian likelihoods.
        seed: random seed of the noise of training and validation.

    Raises:
        ForbesError: when a size is below 1, another number below 0, a choice does not exist, or `likelihood`, `prior`,
            `kl` or `center` does not fit the other arguments.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> world = forbes.WorldModel.for_data(data, belief=forbes.FlowBelief.configured(layers=3))
        >>> batch = data.sequences("test", torch.arange(8))
        >>> world.terms(batch).elbo.shape  # train it with Trainer().fit(world, data)
        torch.Size([8])
    """

    recorded: Callable[[SequenceBatch], LossTerm] | None = None
    """An update that `CudaGraph` has recorded, to replace `total_loss`."""
    adam_eps = 1e-7
    __signature__: ClassVar[inspect.Signature]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Show the arguments of `WorldModel` in the signature of every subclass."""
        super().__init_subclass__(**kwargs)
        cls.__signature__ = full_signature(cls)

    @classmethod
    def for_data(cls, data: SequenceDataModule, **options: Any) -> Self:
        """Build a model with the shapes and the seed of the data, and with networks and a likelihood that fit them.

        Args:
            data: the data that the model learns.
            **options: arguments of the constructor by name. The others have the values of our configurations for such
                data (see `defaults_for`).
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
        """Load a trained model. Only tensors and plain values are read; nothing is unpickled.

        Args:
            checkpoint_path: a checkpoint of a run folder, whose config.yaml has the arguments of the model, or a
                checkpoint of a plain `Trainer`, which has the arguments itself if the model was built by `for_data`.
            map_location: device of the loaded model.
            **arguments: arguments of the constructor that replace those the model was trained with. For a run folder
                they are plain values, as in config.yaml.

        Returns:
            The model in training mode; call `eval()` to measure it.

        Raises:
            ForbesError: where the checkpoint is damaged, of another class, or does not fit the arguments.
        """
        return load_module(Path(checkpoint_path), cls, arguments).train().to(map_location)

    @property
    def objective_name(self) -> str:
        """See `SeededModule.objective_name`: the bound."""
        return self.model.bound_name

    def terms(self, batch: SequenceBatch) -> ElboTerms:
        """Estimate the parts of the bound on a batch."""
        return self.model.lower_bound(batch.observation, batch.action, batch.mask, self.kl)

    def on_fit_start(self) -> None:
        """Refuse a loss that is not what it says; a model that was trained with one can still be evaluated."""
        require_closed_form(self.kl, self.free_nats_per, self.model)

    def on_train_batch_start(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Seed the noise of this batch; check the first observations of an epoch; measure the mean observation."""
        super().on_train_batch_start(batch, batch_idx)
        if batch_idx == 0:
            self.model.likelihood.check(batch.observed)
        if self.model.center is not None and self.batches_before == 0:
            observed = self.model.likelihood.target(batch.observation)[batch.mask]  # (N, *O)
            with shared_batch():
                self.model.center.copy_(sum_over_ranks(observed.sum(0)) / sum_over_ranks(batch.mask.sum()))  # (*O)

    def training_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Return the loss of one update, and log what comes with it."""
        with shared_batch():
            loss, logs = (self.recorded or self.total_loss)(batch)
            self.log_split("train", means_over_ranks(logs), batch)
        return loss

    def total_loss(self, batch: SequenceBatch) -> LossTerm:
        """Return the loss of one update, the sum of its terms."""
        return sum_of_terms([term() for term in self.loss_terms(batch)])

    def loss_terms(self, batch: SequenceBatch) -> list[Callable[[], LossTerm]]:
        """Compute what the terms of the loss share (the filter), and return a function for each term.

        The terms are independent given the filter, so that a GPU may compute them side by side. They depend on batch,
        parameters and noise alone, so that `CudaGraph` can record them.
        """
        terms = self.terms(batch)
        return [lambda: LossTerm(self.loss(terms), self.measures(terms))]

    def loss(self, terms: ElboTerms) -> Tensor:
        """Return the loss of this update in nats per step, a scalar."""
        weight = min(1.0, (self.global_step + 1) / self.kl_warmup) if self.kl_warmup else 1.0
        return elbo_loss(terms, self.free_nats, self.free_nats_per, weight)

    def measure(self, batch: SequenceBatch) -> dict[str, Tensor]:
        """See `SeededModule.measure`: the bound with one sample."""
        return self.measures(self.terms(batch))

    def predict_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Return the bound of each sequence in nats, `(B,)`, with one sample."""
        return self.terms(batch).elbo

    def configure_gradient_clipping(
        self, optimizer: Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip each group to `clip_norm`, log its norm before, and make no step if a norm is not finite."""
        for group in self.groups():
            norm = torch.nn.utils.clip_grad_norm_(group.parameters, self.clip_norm, foreach=True)
            self.log(f"train/gradient_norm_{group.name}", norm)
            self.hold_unless_finite(optimizer, norm)

    def measures(self, terms: ElboTerms) -> dict[str, Tensor]:
        """Return the bound without free nats and its parts in nats per sequence, and auxiliary losses per step."""
        parts = {
            "reconstruction": (terms.reconstruction * terms.mask).sum(1).mean(),
            "kl": (terms.kl * terms.mask).sum(1).mean(),
            **terms.auxiliary,
        }
        values = {self.objective_name: terms.elbo.mean()} | {name: parts[name] for name in self.model.logged_terms}
        for name, log_prob in terms.parts.items():
            values[f"reconstruction/{name}"] = (log_prob * terms.mask).sum(1).mean()
        return {name: value.detach() for name, value in values.items()}


def sum_of_terms(terms: Sequence[LossTerm]) -> LossTerm:
    """Return the sum of the losses, with all that is logged."""
    (first, _), *others = terms
    loss = sum((loss for loss, _ in others), first)
    return LossTerm(loss, {name: value for _, logs in terms for name, value in logs.items()})
