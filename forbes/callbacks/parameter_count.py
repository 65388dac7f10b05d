"""Print the number of parameters of each part of a model."""

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

__all__ = ["ParameterCount", "count_parameters"]

_PARTS = {"transition": "recurrence", "gru": "recurrence", "nothing": "recurrence"}
_PARTS |= {"prior_context": "prior", "posterior_context": "posterior"}  # context networks belong to their belief


class ParameterCount(Callback):
    """Prints the number of parameters of each part at the start of a fit, and logs their total as `parameters`."""

    @rank_zero_only
    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the numbers, and log the total."""
        parts = count_parameters(pl_module.model)  # type: ignore[arg-type]  # pl_module is a WorldModel
        for part, number in parts.items():
            print(f"{part:<12}{number:>12,} parameters", flush=True)
        for logger in trainer.loggers:
            logger.log_metrics({"parameters": parts["total"]}, step=trainer.global_step - 1)


def count_parameters(model: nn.Module) -> dict[str, int]:
    """Return the number of parameters of each part, in the order of the model, and the `total`."""
    parts: dict[str, int] = {}
    for name, parameter in model.named_parameters():
        part = name.partition(".")[0]
        part = _PARTS.get(part, part)
        parts[part] = parts.get(part, 0) + parameter.numel()
    return parts | {"total": sum(parts.values())}
