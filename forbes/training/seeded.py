"""What every training shares: noise that depends on the seed, learning rates, and what is logged."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, cast

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from forbes.data import SequenceBatch
from forbes.distributed import WeightedMeans, num_ranks, rank
from forbes.errors import ForbesError
from forbes.models.world import Schedule
from forbes.seeding import derive_seed
from forbes.training.divergence import hold_unless_finite

__all__ = ["Group", "SeededModule"]


class Group(NamedTuple):
    """Parameters that share a learning rate, and whose gradients are clipped together."""

    name: str
    parameters: list[nn.Parameter]
    rate: float


class SeededModule(LightningModule, ABC):
    r"""A LightningModule whose training is a function of its seed, also when it is interrupted and resumed.

    The noise of an update depends on the seed, the number of the update and the rank, that of a validation on the seed
    and the number of the batch. The learning rate of Adam in update n of N is

    .. math:: \min(1, \tfrac{n + 1}{\mathrm{warmup}})\,\mathrm{rate} \quad\text{and with a cosine times}\quad
              \tfrac12 (1 + \cos \tfrac{\pi n}{N})

    A subclass implements, in the order in which they are called:

    - `groups`: parameters and their learning rates; one group of all parameters by default.
    - `training_step`: the loss of an update.
    - `measure`: what a validation or a test logs of a batch.
    - `objective_name`: which of these values says how well the training goes.

    Its constructor sets the learning rate of Adam at its highest, and the random seed.
    """

    adam_eps: ClassVar[float] = 1e-8
    learning_rate: float
    """Learning rate of Adam at its highest."""
    seed: int
    """Random seed of the noise of training and validation."""
    schedule: Schedule = "constant"
    """Either "constant", or "cosine" to 0 at the end of the training."""
    warmup: int = 0
    """Updates over which the learning rate rises from 0."""

    def groups(self) -> list[Group]:
        """Return which parameters share a learning rate and are clipped together."""
        return [Group("model", [*self.parameters()], self.learning_rate)]

    @abstractmethod
    def measure(self, batch: SequenceBatch) -> dict[str, Tensor]:
        """Return what a validation or a test logs of a batch: scalars by name."""

    @property
    @abstractmethod
    def objective_name(self) -> str:
        """Name the metric, without its split, that says how well the training goes."""

    def configure_optimizers(self) -> Any:
        """Return Adam and its schedule. It is fused, since a step over many small tensors is bound by calls.

        Raises:
            ForbesError: if the schedule is a cosine, and the training has no end at which the rate is 0.
        """
        if self.schedule == "cosine" and math.isinf(self.trainer.estimated_stepping_batches):
            raise ForbesError(
                f"{type(self).__name__}: its schedule is a cosine to 0 at the last update, which this training does "
                "not have. Set trainer.max_epochs or trainer.max_steps"
            )
        groups = [{"params": group.parameters, "lr": group.rate} for group in self.groups()]
        optimizer = Adam(groups, eps=self.adam_eps, fused=True)
        scheduler = LambdaLR(optimizer, self._rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_train_start(self) -> None:
        """Set the learning rates of the configuration: a checkpoint brings its own, which may have changed since."""
        scheduler = cast(LambdaLR, self.lr_schedulers())
        scheduler.base_lrs = [group.rate for group in self.groups()]
        groups = scheduler.optimizer.param_groups
        for group, rate, factor in zip(groups, scheduler.base_lrs, scheduler.lr_lambdas, strict=True):
            group["lr"] = rate * factor(scheduler.last_epoch)

    def hold_unless_finite(self, optimizer: Optimizer, norm: Tensor) -> None:
        """Let the optimiser change nothing from this update on, if the norm of a gradient is not finite."""
        hold_unless_finite(optimizer, norm, self.global_step)

    def on_train_batch_start(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Seed the noise of this batch, so that a resumed run draws the same."""
        self.seed_update(rank())

    def seed_update(self, of_rank: int) -> None:
        """Seed the noise of a rank's share of the current batch."""
        purpose = f"update/{of_rank}" if of_rank else "update"
        torch.manual_seed(derive_seed(self.seed, purpose, self.batches_before))

    def on_validation_epoch_start(self) -> None:
        """Begin the means of a validation."""
        self._means = WeightedMeans()

    def validation_step(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Add `measure` of a batch of the validation split."""
        self._add("validation", batch, batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Log the means of the validation split."""
        self._log_means("val")

    def on_test_epoch_start(self) -> None:
        """Begin the means of a test."""
        self._means = WeightedMeans()

    def test_step(self, batch: SequenceBatch, batch_idx: int) -> None:
        """Add `measure` of a batch of the test split. `forbes evaluate` and `forbes beliefs` measure more carefully."""
        self._add("test", batch, batch_idx)

    def on_test_epoch_end(self) -> None:
        """Log the means of the test split."""
        self._log_means("test")

    def _add(self, split: str, batch: SequenceBatch, batch_idx: int) -> None:
        """Measure a batch with the noise of its number in the split, of which rank r of R has r, r + R, ..."""
        if len(batch.mask) == 0:  # of a rank for which there is none
            return
        torch.manual_seed(derive_seed(self.seed, split, batch_idx * num_ranks() + rank()))
        self._means.add(self.measure(batch), len(batch.mask))

    def _log_means(self, split: str) -> None:
        """Log the means over all batches of all ranks."""
        self.log_dict({f"{split}/{name}": value for name, value in self._means.compute().items()})

    def log_split(self, split: str, values: Mapping[str, Tensor], batch: SequenceBatch) -> None:
        """Log scalars of a batch by name, as `train/name`."""
        self.log_dict({f"{split}/{name}": value for name, value in values.items()}, batch_size=len(batch.mask))

    @property
    def batches_before(self) -> int:
        """Number of training batches before the current one; equal to the updates unless gradients accumulate."""
        trainer = self._trainer
        return 0 if trainer is None else trainer.fit_loop.total_batch_idx

    def _rate(self, update: int) -> float:
        """Return the learning rate of an update as a fraction of the group's."""
        rise = min(1.0, (update + 1) / self.warmup) if self.warmup else 1.0
        if self.schedule == "constant":
            return rise
        done = min(1.0, update / self.trainer.estimated_stepping_batches)
        return rise * 0.5 * (1 + math.cos(math.pi * done))
