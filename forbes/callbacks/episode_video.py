"""An agent in an episode, as a video."""

from pathlib import Path
from typing import cast

from lightning import LightningModule, Trainer

from forbes.callbacks.collect import Collect, require_agent
from forbes.callbacks.picture import FileCallback, require_frames
from forbes.data import SequenceDataModule
from forbes.figures.video import gif
from forbes.files import replace_file
from forbes.training.acting import WorldModelAgent
from forbes.training.world_model import WorldModel

__all__ = ["EpisodeVideo"]


class EpisodeVideo(FileCallback):
    """Writes `figures/episode.gif`: an episode without exploration, the first of those that `Collect` measures by.

    Args:
        every: play after every k-th epoch.

    Raises:
        ForbesError: in a fit, where no agent learns, or the observations are not images.
    """

    filename = "episode.gif"

    def __init__(self, every: int = 10) -> None:
        super().__init__(every)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse what cannot be filmed, before hours are spent."""
        require_agent(self, trainer, pl_module)
        require_frames(self, trainer)

    def write(self, trainer: Trainer, module: WorldModel, data: SequenceDataModule, path: Path) -> None:
        """See `FileCallback`."""
        callbacks = trainer.callbacks  # type: ignore[attr-defined]  # Lightning gives it no type
        collect = next(callback for callback in callbacks if isinstance(callback, Collect))
        episode = collect.evaluation_episode(trainer, cast(WorldModelAgent, module), 0)
        replace_file(path, gif([episode.observation]))
