"""Plot the returns of an agent during training."""

from typing import TYPE_CHECKING

from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.collect import require_agent
from forbes.callbacks.picture import PictureCallback, require_metrics
from forbes.data import Experience, SequenceDataModule
from forbes.data.datamodule import datamodule_of
from forbes.figures.returns import return_curve
from forbes.runs.folder import read_metrics
from forbes.training.world_model import WorldModel

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ReturnCurve"]


class ReturnCurve(PictureCallback):
    """Draws `figures/return.png`: the `return/acting` and `return/exploring` of `Collect` against `env_steps`.

    The curves are read from `metrics.jsonl`, so a resumed run shows all of its epochs.

    Args:
        reference: file of published curves of the same task to compare with; its format is that of `published_curves`.
            Default: those of `forbes data fetch curves`, if they are stored and include the task.
        every: number of epochs between plots.

    Raises:
        ForbesError: at the start of a fit, if the model is not an agent, the file is invalid or lacks the task, or no
            metrics.jsonl is written.
    """

    filename = "return.png"

    def __init__(self, reference: str | None = None, every: int = 5) -> None:
        super().__init__(every)
        self.reference = reference

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be drawn when the training starts."""
        require_agent(self, trainer, pl_module)
        require_metrics(self, trainer)
        self._published(datamodule_of(trainer))

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw the returns."""
        task, published = self._published(data)
        return return_curve(read_metrics(self.folder), task, published)

    def _published(self, data: SequenceDataModule) -> "tuple[str, dict[str, list[pd.Series]]]":
        """Return the task, and its published curves."""
        from forbes.evaluation.published import published_curves  # imports pandas

        source = data.source
        assert isinstance(source, Experience)
        return source.task, published_curves(self.reference, source.task)
