"""`forbes data import` and `export`: episodes from and to other formats."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.episodes import count_steps
from forbes.data.episodes.episode import EpisodeRecord
from forbes.data.episodes.store import EpisodeStore
from forbes.data.exports import export_store
from forbes.data.imports.formats import open_reader
from forbes.data.imports.importing import import_episodes, is_imported, partial_path
from forbes.data.imports.source import Source
from forbes.data.imports.survey import SAMPLE, survey
from forbes.files import require_room

__all__ = ["export", "import_"]


def import_(
    path: str,
    output: Path,
    format: str | None = None,
    image: Sequence[str] | None = None,
    proprio: Sequence[str] | None = None,
    action: str | None = None,
    action_sizes: Sequence[int] | None = None,
    reward: str | None = None,
    resize: int | None = None,
    fps: float | None = None,
    dry_run: bool = False,
) -> None:
    """Import recorded episodes to a new store. If interrupted, the same call resumes.

    Args:
        path: file or folder of the recorded episodes, or the id of a Minari data set.
        output: folder of the new store. It appears when the import is complete; until then there is `output.partial`.
        format: name of the format. Default: the one that recognises the path.
        image: keys of images of the observation.
        proprio: keys of vectors of the observation, which are joined.
        action: key of the action.
        action_sizes: number of options of each choice in a discrete action.
        reward: key of the reward.
        resize: side of the images in pixels.
        fps: steps per second to keep.
        dry_run: print what there is, and import nothing.

    Raises:
        ForbesError: if an episode is damaged, or an option does not fit the data.
    """
    recorded, keys = open_reader(Path(path), format), (image or (), proprio or (), action, reward)
    source = Source(recorded, Path(path), *keys, resize, fps, action_sizes or ())
    _print(source)
    if dry_run:
        return
    if is_imported(source, output):
        print(f"{output}: already imported, {len(source)} episodes")
        return
    begun = EpisodeStore(partial_path(output)).watermark
    imported = import_episodes(source, output)
    records: list[EpisodeRecord] = []
    bar = Console(stderr=True)
    for record in track(imported, f"Importing {path}", len(source), completed=begun, console=bar):
        if not records:
            require_room(partial_path(output), "the remaining episodes", (len(source) - begun - 1) * record.size)
        records.append(record)
    print(f"{output}: {len(records)} episodes imported, {count_steps(records)}")


def export(path: Path, output: Path, format: str) -> None:
    """Export the episodes of a store to another format, without loss.

    Args:
        path: folder of the store.
        output: file or folder to write, which must not exist.
        format: name of the format.

    Raises:
        ForbesError: if the store has no episodes, an episode is damaged, or the output exists.
    """
    store = EpisodeStore(path)
    store.require_episodes()
    exported = export_store(store, output, format)
    count = sum(1 for _ in track(exported, f"Exporting {path}", len(store.records), console=Console(stderr=True)))
    print(f"{output}: {count} episodes exported, {count_steps(list(store.records.values()))}")


def _print(source: Source) -> None:
    found = survey(source)
    table = Table("key", "becomes", "shape", "dtype", f"range (first {SAMPLE} episodes)")
    for row in found.rows:
        table.add_row(*map(escape, row))
    shown = console(120)
    shown.print(table)
    for name, value in found.facts.items():
        shown.print(f"{name:<12}{value}", markup=False, highlight=False, soft_wrap=True)
