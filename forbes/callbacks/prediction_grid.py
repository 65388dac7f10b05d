"""Sampled completions of validation digits while the model learns (paper, Figure 4)."""

from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.picture import PictureCallback, require_context, require_frames, to_device
from forbes.data import SequenceDataModule
from forbes.errors import require_at_least
from forbes.evaluation.predictions import complete, first_of_each_class, whole_sequences
from forbes.figures.grids import Panel, draw_panels, seen_panel, truth_panel
from forbes.figures.style import BLUE
from forbes.training.world_model import WorldModel

__all__ = ["PredictionGrid"]


class PredictionGrid(PictureCallback):
    """Draws `figures/predictions.png`: true digit | some of the frames seen | N sampled completions.

    A row a digit: the first of each class of the validation split, then the second. Completions are shown at the
    module's own length and, where digits go on, at the end of the longest; a column is one trajectory. Of written
    strokes each completion is a drawing, one pixel a step.

    Args:
        digits: rows.
        samples: N.
        context: frames that the model sees.
        every: draw after every k-th epoch.
    """

    filename = "predictions.png"

    def __init__(self, digits: int = 10, samples: int = 6, context: int = 15, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "PredictionGrid", digits=digits, samples=samples, context=context)
        self.digits, self.samples, self.context = digits, samples, context

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be drawn, before hours are spent."""
        require_frames(self, trainer)
        require_context(self, trainer, self.context)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """See `PictureCallback`."""
        index = first_of_each_class(data, "validation", self.digits)
        batch = to_device(whole_sequences(data, "validation", index), module)
        times = sorted({data.length, batch.observation.shape[1]})
        completions = complete(module.model, data.source, batch, self.context, self.samples)
        sampled = [
            Panel(f"sampled completions, t = {time}", completions.at(time).transpose(0, 1), BLUE) for time in times
        ]
        pictures = data.source.pictures(batch.observation)
        return draw_panels([truth_panel(pictures, times[::-1]), seen_panel(pictures, self.context), *sampled])
