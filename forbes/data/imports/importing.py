"""Import recorded episodes to a new episode store, which appears when it is complete."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from forbes.data.episodes.episode import Episode, EpisodeRecord, arrays_of
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.data.imports.source import Source
from forbes.errors import ForbesError
from forbes.files import fsync_folder

__all__ = ["import_episodes", "is_imported", "partial_path"]


def partial_path(output: Path) -> Path:
    """Return the folder in which a store grows until it is complete."""
    return output.with_name(f"{output.name}.partial")


def is_imported(source: Source, output: Path) -> bool:
    """Return whether a folder is already the store of this source.

    Raises:
        ForbesError: if the folder exists and is anything else.
    """
    if not output.exists():
        return False
    store = EpisodeStore(output) if output.is_dir() else None
    if store and len(store.records) == len(source) and all(_holds(store, n, source) for n in (0, len(source) - 1)):
        return True
    raise ForbesError(f"{output}: exists and is not a store of {source.path}. Choose another folder, or delete it")


def import_episodes(source: Source, output: Path) -> Iterator[EpisodeRecord]:
    """Import all episodes, or after an interruption the remaining ones, and yield their records.

    They are written to `partial_path(output)`, which is renamed at the end, so `output` never has a part of them. One
    episode is in memory at a time. An interrupted import results in the same files as an uninterrupted one.

    Args:
        source: the episodes.
        output: folder of the new store.

    Raises:
        ForbesError: if an episode is damaged, or the source is not the one of which episodes were imported before.
    """
    partial = partial_path(output)
    with EpisodeWriter(partial) as writer:
        start = writer.watermark
        if start and not (start <= len(source) and _holds(writer, start - 1, source)):
            raise ForbesError(
                f"{partial}: has episodes that are not those of {source.path} and its options. Delete it to start again"
            )
        for number in range(start, len(source)):
            yield writer.append(source.episode(number), seed=0, policy="recorded", environment=source.describe())
        writer.index.compact()  # the same lines, whether or not a kill had left some to repair
    shutil.rmtree(partial / "set_aside", ignore_errors=True)  # an episode that a kill left without its line
    partial.rename(output)
    fsync_folder(output.parent)


def _holds(store: EpisodeStore, number: int, source: Source) -> bool:
    """Return whether an episode of the store is that of the source."""
    if number not in store.records or store.records[number].environment != source.describe():
        return False
    return _equal(store.episode(number), source.episode(number))


def _equal(one: Episode, other: Episode) -> bool:
    ours, theirs = arrays_of(one), arrays_of(other)
    if (one.terminated, one.frames) != (other.terminated, other.frames):
        return False
    return ours.keys() == theirs.keys() and all(np.array_equal(ours[name], theirs[name]) for name in ours)
