"""Several futures that a model imagines from one belief."""

from lightning import LightningModule, Trainer
from matplotlib.figure import Figure

from forbes.callbacks.picture import PictureCallback, require_context, require_frames, shown_sequences
from forbes.data import SequenceBatch, SequenceDataModule
from forbes.errors import require_at_least
from forbes.evaluation.predictions import complete
from forbes.figures import imagination
from forbes.training.world_model import WorldModel

__all__ = ["ImaginedFutures"]


class ImaginedFutures(PictureCallback):
    """Draws `figures/futures.png`: a true sequence, and below it N futures by its actions, each from its own sample.

    All N are samples of one belief over (h, s), that after `context` frames, each on its own trajectory: where they
    differ, the belief is open. The sequence is the first of `shown_sequences`.

    Args:
        samples: N.
        context: frames that the model sees.
        columns: frames shown of each future, evenly to the end of the sequence.
        every: draw after every k-th epoch.

    Raises:
        ForbesError: where a number is below 1; in a fit, for vectors.
    """

    filename = "futures.png"

    def __init__(self, samples: int = 6, context: int = 5, columns: int = 12, every: int = 5) -> None:
        super().__init__(every)
        require_at_least(1, "ImaginedFutures", samples=samples, context=context, columns=columns)
        self.samples, self.context, self.columns = samples, context, columns

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be drawn, before hours are spent."""
        require_frames(self, trainer)
        require_context(self, trainer, self.context)

    def draw(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule) -> Figure:
        """See `PictureCallback`."""
        batch = shown_sequences(data, 1, module)
        last = max(self.context + 1, int(batch.mask.sum()))
        batch = SequenceBatch(*(values[:, :last] for values in batch))  # (1, last, ...)
        truth = data.source.pictures(module.model.likelihood.picture(batch.observation))[0]  # (last, C, H, W)
        completions = complete(module.model, data.source, batch, self.context, self.samples)
        futures = completions.frames[:, 0]  # (N, last - context, C, H, W)
        return imagination.imagined_futures(truth, futures, self.context, self.columns)
