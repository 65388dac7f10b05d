"""Draw several futures that a model imagines from one belief."""

from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.picture import PictureCallback, require_context, require_frames, shown_sequences
from forbes.data import SequenceDataModule
from forbes.errors import require_at_least
from forbes.evaluation.predictions import complete
from forbes.figures import imagination
from forbes.figures.prediction_grid import colour_of
from forbes.training.world_model import WorldModel

__all__ = ["ImaginedFutures"]


class ImaginedFutures(PictureCallback):
    """Draws `figures/futures.png`: a true sequence, and below it N imagined futures for the same actions.

    The futures start from N samples of the belief over (h, s) after `context` frames, each on its own trajectory. Where
    they differ, the belief is uncertain. The sequence is the first of `shown_sequences`. Of observations of several
    parts, the images are drawn side by side, and vectors are left out.

    Args:
        samples: number of futures, N.
        context: number of frames that the model sees.
        columns: number of frames shown per future, evenly spaced to the end of the sequence.
        every: number of epochs between figures.

    Raises:
        ForbesError: if a number is below 1, or, at the start of a fit, if the observations are not images.
    """

    filename = "futures.png"

    def __init__(self, samples: int = 6, context: int = 5, columns: int = 12, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "ImaginedFutures", samples=samples, context=context, columns=columns)
        self.samples, self.context, self.columns = samples, context, columns

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse data that cannot be drawn when the training starts."""
        require_frames(self, trainer)
        require_context(self, trainer, self.context)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """Draw the sequence and the futures."""
        batch = shown_sequences(data, 1, module)
        last = max(self.context + 1, int(batch.mask.sum()))
        batch = batch.first(last)  # (1, last, ...)
        likelihood = module.model.likelihood
        truth = data.source.pictures(likelihood.images(likelihood.picture(batch.observation)))[0]  # (last, C, H, W)
        completions = complete(module.model, data.source, batch, self.context, self.samples)
        futures = completions.frames[:, 0]  # (N, last - context, C, H, W)
        return imagination.draw_futures(truth, futures, self.context, self.columns, colour_of(module.model))
