"""The size of a model, part by part."""

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

__all__ = ["ParameterCount", "count_parameters"]

_PARTS = {"transition": "recurrence", "gru": "recurrence", "nothing": "recurrence"}
_PARTS |= {"prior_context": "prior", "posterior_context": "posterior"}  # the contexts belong to their belief


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


def count_parameters(model: nn.Module) -> dict[str, int]:
    """Count by part, in the model's order, and the whole."""
    parts: dict[str, int] = {}
    for name, parameter in model.named_parameters():
        part = name.partition(".")[0]
        part = _PARTS.get(part, part)
        parts[part] = parts.get(part, 0) + parameter.numel()
    return parts | {"total": sum(parts.values())}
