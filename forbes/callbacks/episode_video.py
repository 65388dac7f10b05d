"""Record an episode of an agent as a video."""

from pathlib import Path
from typing import cast

from lightning import LightningModule, Trainer

from forbes.callbacks.collect import Collect, require_agent
from forbes.callbacks.picture import FileCallback, require_frames
from forbes.data import SequenceDataModule
from forbes.figures.episodes import frames_of
from forbes.figures.video import gif
from forbes.files import replace_file
from forbes.training.acting import WorldModelAgent
from forbes.training.world_model import WorldModel

__all__ = ["EpisodeVideo"]


class EpisodeVideo(FileCallback):
    """Writes `figures/episode.gif`: an episode without exploration, the first evaluation episode of `Collect`.

    Args:
        every: number of epochs between videos.

    Raises:
        ForbesError: at the start of a fit, if the model is not an agent, or the observations are not images.
    """

    filename = "episode.gif"

    def __init__(self, every: int = 10) -> None:
        super().__init__(every)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse models and data that cannot be recorded when the training starts."""
        require_agent(self, trainer, pl_module)
        require_frames(self, trainer)

    def write(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule, path: Path) -> None:
        """Play the episode and write the GIF."""
        callbacks = trainer.callbacks  # type: ignore[attr-defined]  # untyped in Lightning
        collect = next(callback for callback in callbacks if isinstance(callback, Collect))
        episode = collect.evaluation_episode(trainer, cast(WorldModelAgent, module), 0)
        replace_file(path, gif([frames_of(episode.observation)]))
