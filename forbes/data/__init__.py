"""Data: one DataModule for sequences from several kinds of sources."""

from forbes.data.datamodule import SequenceDataModule
from forbes.data.episodes.episode import Episode
from forbes.data.episodes.experience import Experience
from forbes.data.episodes.replay import Replay
from forbes.data.episodes.store import EpisodeWriter
from forbes.data.simulated import Simulated
from forbes.data.source import SequenceBatch, SequenceSource, Split
from forbes.data.strokes.source import Strokes

__all__ = [
    "Episode",
    "EpisodeWriter",
    "Experience",
    "Replay",
    "SequenceBatch",
    "SequenceDataModule",
    "SequenceSource",
    "Simulated",
    "Split",
    "Strokes",
]
