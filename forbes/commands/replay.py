"""`forbes replay`: recompute an update that was not finite, and name the first tensor that is not."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor, nn

from forbes.commands.parsers.replay import parser
from forbes.data import SequenceBatch
from forbes.data.source import check_batch
from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.configuration import allow_modules
from forbes.runs.folder import RunFolder
from forbes.runs.modules import build_run
from forbes.runs.worlds import check_weights
from forbes.training.known_belief import KnownBelief
from forbes.training.world_model import WorldModel

__all__ = ["first_not_finite", "main"]

_FIELDS = {"update": int, "seed": int, "device": str, "precision": str}
_FIELDS |= {"state_dict": Mapping, "batch_numbers": list, "batches": list}


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments.

    Raises:
        ForbesError: if the file is not the failure.pt of a divergence, or the update is finite now.
    """
    path = parser().parse_args(argv).failure
    if not path.is_file():
        raise ForbesError(f"{path}: no such file. Name the failure.pt in the folder of a run that diverged")
    failure = read_checkpoint(path)
    if problem := _problem_of(failure):
        raise ForbesError(f"{path}: {problem}, expected the failure.pt of a run that diverged. Name one")
    allow_modules()
    module, data, _ = build_run(RunFolder(path.parent))
    if not isinstance(module, WorldModel | KnownBelief):
        name = type(module).__name__
        raise ForbesError(f"{path}: of a {name}, expected a WorldModel or a KnownBelief. Compute its loss in Python")
    check_weights(module, failure["state_dict"], str(path))
    for batch in failure["batches"]:
        check_batch(data.source, SequenceBatch(**batch))
    device = failure["device"] if torch.cuda.is_available() else "cpu"
    found = first_not_finite(module, failure, device)
    update = f"{path}: update {failure['update'] + 1}, recomputed on {device}"
    if found is None:
        raise ForbesError(
            f"{update}, is finite; it was not on {failure['device']}. Replay it there, with the version and the "
            "config.yaml of the training"
        )
    print(f"{update}: the first tensor that is not finite is {found}")


def first_not_finite(module: WorldModel | KnownBelief, failure: Mapping[str, Any], device: str = "cpu") -> str | None:
    """Recompute an update and describe its first tensor that is not finite; return None if all are finite.

    Args:
        module: module built from the run's configuration. The weights before the update are loaded into it.
        failure: content of `failure.pt`.
        device: device to compute on.
    """
    module.load_state_dict(failure["state_dict"])
    module.to(device).train()
    watch = _Watch(module)
    for number, content in zip(failure["batch_numbers"], failure["batches"], strict=True):
        for name, values in content.items():
            watch.look(f"{name} of batch {number}", values)
        batch = SequenceBatch(**content).to(device)
        _stand_before(module, failure["update"], number)
        module.on_train_batch_start(batch, batch_idx=1)  # seeds the noise; index 0 would check the data of an epoch
        for rank, share in enumerate(_shares(batch, failure.get("processes", 1))):
            if rank:
                module.seed_update(rank)
            with torch.autocast(device, torch.bfloat16, enabled=failure["precision"].startswith("bf16")):
                loss, terms = module.total_loss(share) if isinstance(module, WorldModel) else (module.loss(share), {})
            for name, values in terms.items():
                watch.look(f"the loss term {name}", values)
            watch.look("the loss", loss)
            if watch.found:
                return watch.found[0]
            loss.backward()
        module.on_train_batch_end(None, batch, 1)  # moves averages between the batches of an update
    gradients = [parameter.grad for parameter in module.parameters() if parameter.grad is not None]
    watch.look("the norm of all gradients", torch.nn.utils.get_total_norm(gradients))
    return next(iter(watch.found), None)


def _shares(batch: SequenceBatch, processes: int) -> list[SequenceBatch]:
    """Return the part of a batch that each process of the training had."""
    size = len(batch.mask) // processes
    return [batch.rows(slice(rank * size, (rank + 1) * size)) for rank in range(processes)]


class _Watch:
    """Records tensors that are not finite, in the order in which an update computes them.

    Args:
        module: module whose parameters, submodule outputs and gradients are checked.
    """

    def __init__(self, module: LightningModule) -> None:
        self.found: list[str] = []
        for name, values in module.state_dict().items():
            self.look(f"the parameter {name}", values)
        for name, part in module.named_modules():
            part.register_forward_hook(partial(self._after, name))
        for name, parameter in module.named_parameters():
            if parameter.requires_grad:
                parameter.register_post_accumulate_grad_hook(partial(self._accumulated, name))

    def look(self, name: str, values: Any) -> None:
        """Record the tensors in `values` that are not finite."""
        for tensor in _tensors(values):
            if broken := int((~tensor.isfinite()).sum()):
                self.found.append(f"{name}: {broken} of {tensor.numel()} values, shape {tuple(tensor.shape)}")

    def _after(self, name: str, part: nn.Module, inputs: Any, output: Any) -> None:
        self.look(f"the output of {name} ({type(part).__name__})", output)

    def _accumulated(self, name: str, parameter: Tensor) -> None:
        self.look(f"the gradient of {name}", parameter.grad)


def _tensors(values: Any) -> Iterator[Tensor]:
    """Yield the tensors in nested tuples, lists and dictionaries."""
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, Mapping):
        yield from _tensors([*values.values()])
    elif isinstance(values, tuple | list):
        for value in values:
            yield from _tensors(value)


def _stand_before(module: LightningModule, update: int, batch: int) -> None:
    """Set the counters of updates and batches of a module without a Trainer."""
    vars(module)["_trainer"] = SimpleNamespace(global_step=update, fit_loop=SimpleNamespace(total_batch_idx=batch))


def _problem_of(failure: Any) -> str:
    """Return what is wrong with the content of a failure.pt, or an empty string."""
    if not isinstance(failure, dict):
        return f"holds a {type(failure).__name__}"
    for name, kind in _FIELDS.items():
        if not isinstance(failure.get(name), kind):
            return f"its {name} is {type(failure.get(name)).__name__}"
    if not all(isinstance(value, Tensor) for value in failure["state_dict"].values()):
        return "its state_dict has values that are not tensors"
    for batch in failure["batches"]:
        if not isinstance(batch, dict) or {*batch} != {*SequenceBatch._fields}:
            return "one of its batches lacks a field"
        parts = batch["observation"] if isinstance(batch["observation"], dict) else {}
        if not all(isinstance(value, Tensor) for value in (batch | parts).values() if value is not parts):
            return "one of its batches has values that are not tensors"
    processes = failure.get("processes", 1)  # files of older versions have none
    if type(processes) is not int or processes < 1 or any(len(b["mask"]) % processes for b in failure["batches"]):
        return f"its batches cannot be shared by {processes} processes"
    if len(failure["batch_numbers"]) != len(failure["batches"]):
        return "it does not have one number per batch"
    return ""
