"""Draw frames that a model reconstructs, then imagines, below the true frames (as in Dreamer's summaries)."""

from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.picture import (
    PictureCallback,
    require_context,
    require_frames,
    require_state,
    shown_sequences,
)
from forbes.data import SequenceDataModule
from forbes.errors import require_at_least
from forbes.evaluation.predictions import open_loop_frames
from forbes.figures import imagination
from forbes.models import StateSpaceModel
from forbes.training.world_model import WorldModel

__all__ = ["OpenLoopPanel"]


class OpenLoopPanel(PictureCallback):
    """Draws `figures/open_loop.png`: truth, model and error of some sequences, one column per step.

    The model sees and reconstructs the first frames. From its belief after them it imagines the others for the recorded
    actions, one trajectory per sequence. The sequences are those of `shown_sequences`. Of observations of several
    parts, the images are drawn side by side, and vectors are left out.

    Args:
        sequences: number of sequences.
        context: number of frames that the model sees.
        columns: number of frames shown: all of the context, the others evenly spaced to the last.
        every: number of epochs between figures.

    Raises:
        ForbesError: if a number is too small, or, at the start of a fit, if the observations are not images or the
            model has no state.
    """

    filename = "open_loop.png"

    def __init__(self, sequences: int = 3, context: int = 5, columns: int = 15, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "OpenLoopPanel", sequences=sequences, context=context)
        require_at_least(context + 1, "OpenLoopPanel", columns=columns)
        self.sequences, self.context, self.columns = sequences, context, columns

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse models and data that cannot be drawn when the training starts."""
        require_frames(self, trainer)
        require_state(self, pl_module)
        require_context(self, trainer, self.context)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw truth, model and error."""
        model = module.model
        assert isinstance(model, StateSpaceModel)
        batch = shown_sequences(data, self.sequences, module)
        likelihood = model.likelihood
        truth = data.source.pictures(likelihood.images(likelihood.picture(batch.observation)))  # (B, T, C, H, W)
        expected = data.source.pictures(open_loop_frames(model, batch, self.context))
        return imagination.draw_open_loop(truth, expected, batch.mask, self.context, self.columns)
