"""The size of a model, part by part."""

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

from forbes.models import StateSpaceModel

__all__ = ["ParameterCount", "count_parameters"]


class ParameterCount(Callback):
    """Prints the parameters of each part as a fit starts, and logs their total as the metric `parameters`."""

    @rank_zero_only
    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print and log."""
        parts = count_parameters(pl_module.model)  # type: ignore[arg-type]  # a WorldModel's
        for part, number in parts.items():
            print(f"{part:<12}{number:>12,} parameters", flush=True)
        for logger in trainer.loggers:
            logger.log_metrics({"parameters": parts["total"]}, step=trainer.global_step - 1)


def count_parameters(model: StateSpaceModel) -> dict[str, int]:
    """Count by part; the contexts belong to their belief, and the total is of the whole model."""
    parts: dict[str, list[nn.Module]] = {
        "encoder": [model.encoder],
        "recurrence": [model.transition, model.gru],
        "prior": [model.prior_context, model.prior],
        "posterior": [model.posterior_context, model.posterior],
        "decoder": [model.decoder],
        "total": [model],
    }
    return {part: sum(_size(module) for module in modules) for part, modules in parts.items()}


def _size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
