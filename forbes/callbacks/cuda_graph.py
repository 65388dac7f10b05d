"""Record an update once on a GPU and replay it, so that none of its thousands of kernels waits for Python."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any, cast

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.autograd.function import once_differentiable

from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.performance.fusion import fusing
from forbes.shapes import map_parts
from forbes.training.world_model import LossTerm, WorldModel, sum_of_terms

__all__ = ["CudaGraph", "Recording"]

_WARM_UP = 3


class CudaGraph(Callback):
    """Records the losses of an update and their gradients as a CUDA graph, before the first update of a fit.

    It sets `WorldModel.recorded`. Every update then copies its batch to the memory of the first one and replays the
    graph: the same kernels with new noise, launched by the device itself. Elementwise operations between two matrix
    products are one kernel (`performance.fusion`). Clipping and Adam stay outside. The results are those of a training
    without it, up to rounding. `benchmarks/gpu.md` has the gain; compilation takes about a minute before the first
    update. On a CPU it does nothing.

    Args:
        tf32: whether the update multiplies float32 matrices with 10 bits of their mantissas (three digits); faster.

    Raises:
        ForbesError: if the module is not a WorldModel, several processes train, `kl_warmup` is set (the loss would
            change between replays), the update synchronises with the host, or there is no triton or C compiler.
    """

    def __init__(self, tf32: bool = False) -> None:
        self.tf32 = tf32

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse modules that cannot be recorded."""
        if not isinstance(pl_module, WorldModel):
            name = type(pl_module).__name__
            raise ForbesError(f"CudaGraph: found a {name}, expected a WorldModel or an agent. Leave CudaGraph out")
        if trainer.world_size > 1:
            raise ForbesError(
                f"CudaGraph: records an update of one process, but {trainer.world_size} share every batch. Leave "
                "CudaGraph out"
            )
        if pl_module.kl_warmup:
            raise ForbesError("CudaGraph: kl_warmup changes the loss between updates, expected 0. Leave one out")

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: SequenceBatch, batch_idx: int
    ) -> None:
        """Record the first update. The module seeds its noise after this."""
        module = cast(WorldModel, pl_module)
        if batch.mask.is_cuda and module.recorded is None:
            with _float32_products("high" if self.tf32 else "highest"):
                module.recorded = Recording(module, batch, trainer.precision_plugin.forward_context)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Let the module compute its losses itself again."""
        cast(WorldModel, pl_module).recorded = None


class Recording:
    """The loss of a module on a GPU, with its gradients, for batches of the same shapes.

    All kernels are one graph. The terms of the loss, which do not depend on each other, are branches of it, with their
    gradients: each alone is too small to fill the device.

    Args:
        module: the module in training mode; its parameters may change their values, not their memory.
        batch: any batch.
        precision: returns the context of the training's mixed precision.
    """

    def __init__(
        self, module: WorldModel, batch: SequenceBatch, precision: Callable[[], AbstractContextManager[Any]]
    ) -> None:
        self.module, self.precision = module, precision
        self.parameters = [parameter for parameter in module.parameters() if parameter.requires_grad]
        self.batch = batch.each(torch.clone)
        self.graph = torch.cuda.CUDAGraph()
        buffers = [buffer.clone() for buffer in module.buffers()]
        try:
            with fusing():
                self._warm_up()
                with torch.cuda.graph(self.graph):
                    (self.loss, self.logs), self.gradients = self._compute()
            for buffer, before in zip(module.buffers(), buffers, strict=True):
                buffer.copy_(before)  # the updates of the warm-up do not count, e.g. in a `ReturnScale`
        except RuntimeError as error:  # of CUDA, and of the compiler
            name, reason = type(module).__name__, str(error).strip().partition("\n")[0]
            raise ForbesError(
                f"CudaGraph: the update of {name} cannot be recorded ({reason}); it must not wait for a number from "
                "the device, and needs triton and a C compiler. Leave CudaGraph out"
            ) from error

    def __call__(self, batch: SequenceBatch) -> LossTerm:
        """See `WorldModel.total_loss`."""
        for ours, theirs in zip(self.batch, batch, strict=True):
            map_parts(Tensor.copy_, ours, theirs)
        self.graph.replay()
        loss: Tensor = _Replayed.apply(self.loss, self.gradients, *self.parameters)  # type: ignore[no-untyped-call]
        return LossTerm(loss, {name: value.clone() for name, value in self.logs.items()})

    def _warm_up(self) -> None:
        """Compute on another stream first, as PyTorch requires, so that compiler and libraries are initialised."""
        here, aside = torch.cuda.current_stream(), torch.cuda.Stream()
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            for _ in range(_WARM_UP):
                self._compute()
        here.wait_stream(aside)

    def _compute(self) -> tuple[LossTerm, list[Tensor | None]]:
        """Return the loss, and the gradient of each parameter that has one."""
        with self.precision():
            loss_terms = self.module.loss_terms(self.batch)  # holds what they share until all are done
        here = torch.cuda.current_stream()
        streams = [here, *_streams(len(loss_terms) - 1)]
        for stream in streams[1:]:
            stream.wait_stream(here)
        terms, gradients_of = [], []
        for compute, stream in zip(loss_terms, streams, strict=True):
            with torch.cuda.stream(stream):
                with self.precision():
                    loss, logs = compute()
                gradients_of.append(torch.autograd.grad(loss, self.parameters, allow_unused=True))
            terms.append(LossTerm(loss.detach(), logs))
        for stream in streams[1:]:
            here.wait_stream(stream)
        return sum_of_terms(terms), [_sum(gradients) for gradients in zip(*gradients_of, strict=True)]


@contextmanager
def _float32_products(precision: str) -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


class _Replayed(torch.autograd.Function):
    """Returns a recorded loss, and in the backward pass the recorded gradients."""

    @staticmethod
    def forward(ctx: Any, loss: Tensor, gradients: list[Tensor | None], *parameters: Tensor) -> Tensor:
        ctx.gradients = gradients
        return loss.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(None if each is None else each * grad for each in ctx.gradients)


@cache
def _streams(number: int) -> list[torch.cuda.Stream]:
    """Return streams, the same ones in every call, since gradients run on those of their loss."""
    return [torch.cuda.Stream() for _ in range(number)]


def _sum(gradients: tuple[Tensor | None, ...]) -> Tensor | None:
    """Return the sum of the gradients that exist."""
    found = [each for each in gradients if each is not None]
    return torch.stack(found).sum(0) if len(found) > 1 else next(iter(found), None)
