"""An update recorded once on a GPU, and played back: none of its thousands of kernels waits for Python any more."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor, nn

from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.fusion import fusing
from forbes.training.world_model import WorldModel

__all__ = ["CudaGraph", "record"]


class CudaGraph(Callback):
    """Records the losses of an update and their gradients as CUDA graphs, before the first update of a fit.

    Every later update copies its batch to where the first one lay, and plays them back: the same kernels with new
    noise, started by the device itself. What is elementwise between matrix products is one kernel (`forbes.fusion`).
    Clipping and Adam stay as they are. The numbers are those of a training without it, up to rounding.

    On a CPU it does nothing.

    Raises:
        ForbesError: where the loss changes from update to update by itself (`kl_warmup`).
    """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be recorded."""
        if getattr(pl_module, "kl_warmup", 0):
            raise ForbesError("CudaGraph: kl_warmup weighs every update anew, expected 0. Leave one of them out")

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: SequenceBatch, batch_idx: int
    ) -> None:
        """Record; the module seeds the noise of its update after this."""
        if isinstance(pl_module, WorldModel) and batch.mask.is_cuda and "losses" not in vars(pl_module):
            vars(pl_module)["losses"] = record(pl_module, batch, trainer.precision_plugin.forward_context)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Give the module its own losses back."""
        vars(pl_module).pop("losses", None)


def record(
    module: WorldModel, batch: SequenceBatch, precision: Callable[[], AbstractContextManager[Any]]
) -> Callable[[SequenceBatch], tuple[Tensor, dict[str, Tensor]]]:
    """Record the losses of a module on a GPU, with their gradients, for batches of the same shapes.

    Args:
        module: in training mode; its parameters may change their values, not their memory.
        batch: any.
        precision: gives the context of the training's mixed precision.
    """
    with fusing():
        recorded: Callable[..., Any] = torch.cuda.make_graphed_callables(
            _Losses(module, precision), tuple(values.clone() for values in batch), allow_unused_input=True
        )
    return lambda batch: recorded(*batch)


class _Losses(nn.Module):
    """The losses of a module as what can be recorded: a function of tensors, which has its parameters."""

    def __init__(self, module: WorldModel, precision: Callable[[], AbstractContextManager[Any]]) -> None:
        super().__init__()
        self.module, self.precision = module, precision

    def forward(self, *values: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        with self.precision():  # the gradients' kernels take theirs from the tensors
            return self.module.losses(SequenceBatch(*values))
