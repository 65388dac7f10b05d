"""Plot the bound and its parts during training."""

from typing import TYPE_CHECKING

import torch
from lightning import LightningModule, Trainer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from forbes.callbacks.picture import PictureCallback, require_metrics, require_validation
from forbes.data import SequenceDataModule
from forbes.errors import require_at_least
from forbes.evaluation.references import reference_means
from forbes.figures.prediction_grid import colour_of
from forbes.figures.style import BLACK, GREY, PAGE, draw_references, paper_style, show_settled
from forbes.runs.folder import read_metrics
from forbes.training.world_model import WorldModel

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ElboCurve"]

_TITLES = {"kl": "KL", "overshoot": "rollout loss"}


class ElboCurve(PictureCallback):
    """Draws `figures/elbo.png`: the bound and its parts for both splits against updates, and the KL at each step.

    A model without a KL has its rollout loss instead. Dotted lines are scores of models without a belief on the same
    sequences (`forbes.evaluation.references`). The curves are read from `metrics.jsonl`, so a resumed run shows all of
    its updates.

    Args:
        sequences: number of validation sequences for the KL at each step.
        every: number of epochs between plots.
    """

    filename = "elbo.png"

    def __init__(self, sequences: int = 200, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "ElboCurve", sequences=sequences)
        self.sequences = sequences

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse data without a validation split, and trainings without metrics.jsonl, when the training starts."""
        require_validation(self, trainer)
        require_metrics(self, trainer)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw the curves."""
        metrics = read_metrics(self.folder)
        names = [module.objective_name, *module.model.logged_terms]
        has_kl, colour = "kl" in names, colour_of(module.model)
        with paper_style():
            figure = Figure((PAGE, 4.2 if has_kl else 2.3), layout="constrained")
            axes = figure.subplots(2 if has_kl else 1, 2).flat
            for panel, name in zip(axes, names, strict=False):
                _draw_curves(panel, metrics, name, colour)
                unit = "step" if name == "overshoot" else "sequence"
                panel.set(title=_TITLES.get(name, name), xlabel="updates", ylabel=f"nats per {unit}")
            if has_kl:
                _draw_steps(axes[3], *self._kl_per_step(module, data), colour)
            draw_references(axes[0], self._references(module, data))
            if axes[0].get_legend_handles_labels()[0]:
                axes[0].legend()
        return figure

    def _references(self, module: WorldModel, data: SequenceDataModule) -> dict[str, float]:
        """Return the mean reference scores over the validation sequences."""
        count = min(data.validation_sequences, data.source.size("validation"))
        return reference_means(data, module.model.likelihood, "validation", count)

    def _kl_per_step(self, module: WorldModel, data: SequenceDataModule) -> tuple[Tensor, Tensor]:
        """Return mean and standard error over sequences of the KL at each step, each `(T,)`."""
        index = torch.arange(min(self.sequences, data.source.size("validation")))
        batches = [data.sequences("validation", part).to(module.device) for part in index.split(data.batch_size)]
        terms = [module.terms(batch) for batch in batches]
        kl = torch.cat([term.kl.masked_fill(~term.mask, torch.nan) for term in terms]).cpu()  # (B, T)
        count = kl.isfinite().sum(0)
        spread = (kl - kl.nanmean(0)).square().nansum(0).div((count - 1).clamp(min=1)).sqrt()
        return kl.nanmean(0), spread / count.sqrt()  # (T,), (T,)


def _draw_curves(axes: Axes, metrics: "pd.DataFrame", name: str, colour: str) -> None:
    """Draw one metric for both splits."""
    curves = []
    for split, label, of_split in [("train", "train", GREY), ("val", "validation", colour)]:
        if f"{split}/{name}" in metrics:
            curves.append(metrics[f"{split}/{name}"].dropna())
            axes.plot(curves[-1].index, curves[-1], color=of_split, label=label)
    show_settled(axes, curves)


def _draw_steps(axes: Axes, mean: Tensor, error: Tensor, colour: str) -> None:
    time = range(1, len(mean) + 1)
    axes.fill_between(time, (mean - error).numpy(), (mean + error).numpy(), color=colour, alpha=0.25, linewidth=0)
    axes.plot(time, mean.numpy(), color=colour)
    axes.axhline(0, color=BLACK, linewidth=0.5)
    axes.set(title="KL at each step, validation", xlabel="t", ylabel="nats")
