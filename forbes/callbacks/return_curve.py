"""What an agent earns while it learns."""

import pandas as pd
from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.collect import require_agent
from forbes.callbacks.picture import PictureCallback
from forbes.data import Experience, SequenceDataModule
from forbes.figures.returns import published_curves, return_curve
from forbes.runs.folder import read_metrics
from forbes.training.world_model import WorldModel

__all__ = ["ReturnCurve"]


class ReturnCurve(PictureCallback):
    """Draws `figures/return.png`: what `Collect` logs, `return/acting` and `return/exploring`, against `env_steps`.

    It reads `metrics.jsonl`, so a resumed run shows its whole life.

    Args:
        reference: a file of published curves of the same task, to draw beside it; see `published_curves`. By default
            those of `forbes data fetch curves`, where they are there and have the task.
        every: draw after every k-th epoch.

    Raises:
        ForbesError: in a fit, where no agent learns, or the file is not one of curves, or lacks the task.
    """

    filename = "return.png"

    def __init__(self, reference: str | None = None, every: int = 5) -> None:
        super().__init__(every)
        self.reference = reference

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be drawn, before hours are spent."""
        require_agent(self, trainer, pl_module)
        self._published(trainer.datamodule)  # type: ignore[attr-defined]  # Lightning gives it no type

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """See `PictureCallback`."""
        task, published = self._published(data)
        return return_curve(read_metrics(str(trainer.log_dir)), task, published)

    def _published(self, data: SequenceDataModule) -> tuple[str, dict[str, list[pd.Series]]]:
        """Return the task, and what others have published of it."""
        source = data.source
        assert isinstance(source, Experience)
        return source.task, published_curves(self.reference, source.task)
