"""Draw sampled completions of validation digits during training (paper, Figure 4)."""

from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.picture import (
    PictureCallback,
    require_context,
    require_frames,
    require_one_array,
    require_validation,
)
from forbes.data import SequenceDataModule
from forbes.errors import require_at_least
from forbes.evaluation.predictions import first_of_each_class, whole_sequences
from forbes.figures.prediction_grid import prediction_grid
from forbes.training.world_model import WorldModel

__all__ = ["PredictionGrid"]


class PredictionGrid(PictureCallback):
    """Draws `figures/predictions.png`: true digit | some of the observed frames | N sampled completions.

    Each row is a digit: the first of each class of the validation split, then the second. Completions are shown at the
    training length and, if digits are longer, at the end of the longest. Each column is one trajectory. For written
    strokes a completion is a binary drawing, one pixel per step.

    Args:
        digits: number of digits.
        samples: number of completions, N.
        context: number of frames that the model sees.
        every: number of epochs between figures.
    """

    filename = "predictions.png"

    def __init__(self, digits: int = 10, samples: int = 6, context: int = 15, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "PredictionGrid", digits=digits, samples=samples, context=context)
        self.digits, self.samples, self.context = digits, samples, context

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse data that cannot be drawn when the training starts."""
        require_one_array(self, trainer)
        require_frames(self, trainer)
        require_validation(self, trainer)
        require_context(self, trainer, self.context)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw the digits and their completions."""
        batch = whole_sequences(data, "validation", first_of_each_class(data, "validation", self.digits))
        return prediction_grid(module.model, data, batch.to(module.device), self.context, self.samples)
