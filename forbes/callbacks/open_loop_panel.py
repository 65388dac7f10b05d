"""Frames that a model reconstructs, then imagines, under the true ones (as in Dreamer's summaries)."""

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
from forbes.evaluation.predictions import open_loop
from forbes.figures import imagination
from forbes.models import StateSpaceModel
from forbes.training.world_model import WorldModel

__all__ = ["OpenLoopPanel"]


class OpenLoopPanel(PictureCallback):
    """Draws `figures/open_loop.png`: truth, model and error of some sequences, a column a step.

    The model sees the first frames and reconstructs them; from its belief there it imagines the others by the actions
    that were taken, one trajectory of each sequence. `shown_sequences` says which these are.

    Args:
        sequences: how many.
        context: frames that the model sees.
        columns: frames shown, those of the context among them; the others evenly to the module's length.
        every: draw after every k-th epoch.

    Raises:
        ForbesError: where a number cannot be; in a fit, for vectors, or a model without a state.
    """

    filename = "open_loop.png"

    def __init__(self, sequences: int = 3, context: int = 5, columns: int = 15, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "OpenLoopPanel", sequences=sequences, context=context)
        require_at_least(context + 1, "OpenLoopPanel", columns=columns)
        self.sequences, self.context, self.columns = sequences, context, columns

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be drawn, before hours are spent."""
        require_frames(self, trainer)
        require_state(self, pl_module)
        require_context(self, trainer, self.context)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """See `PictureCallback`."""
        model = module.model
        assert isinstance(model, StateSpaceModel)
        batch = shown_sequences(data, self.sequences, module)
        truth = data.source.pictures(model.likelihood.picture(batch.observation))  # (B, T, C, H, W)
        expected = data.source.pictures(open_loop(model, batch, self.context))
        return imagination.open_loop(truth, expected, batch.mask, self.context, self.columns)
