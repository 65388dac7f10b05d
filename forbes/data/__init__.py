"""Data: one DataModule for sequences from several kinds of sources.

The DataModule is imported on first use, since it imports Lightning.
"""

from typing import TYPE_CHECKING, Any

from forbes.data.episodes.episode import Episode
from forbes.data.episodes.experience import Experience
from forbes.data.episodes.replay import Replay
from forbes.data.episodes.store import EpisodeWriter
from forbes.data.sequences import SequenceData
from forbes.data.simulated import Simulated
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.data.strokes.source import Strokes

if TYPE_CHECKING:
    from forbes.data.datamodule import SequenceDataModule

__all__ = [
    "Episode",
    "EpisodeWriter",
    "Experience",
    "Replay",
    "SequenceBatch",
    "SequenceData",
    "SequenceDataModule",
    "SequenceSource",
    "Simulated",
    "Split",
    "Strokes",
]


def __getattr__(name: str) -> Any:
    """Import the DataModule."""
    if name != "SequenceDataModule":
        raise AttributeError(f"module 'forbes.data' has no attribute {name!r}")
    from forbes.data.datamodule import SequenceDataModule

    return SequenceDataModule
