"""How far an evaluation has come."""

import sys
from collections.abc import Iterator

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from forbes.data import SequenceBatch

__all__ = ["with_progress"]


def with_progress(
    batches: Iterator[tuple[int, SequenceBatch]], name: str, sequences: int
) -> Iterator[tuple[int, SequenceBatch]]:
    """Pass batches on, with a bar on a terminal and a line at each tenth elsewhere."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(escape(name), total=sequences)
        tenth = 0
        for first, batch in batches:
            yield first, batch
            bar.advance(task, len(batch.mask))
            done = first + len(batch.mask)
            if bar.disable and 10 * done // sequences > tenth:
                tenth = 10 * done // sequences
                print(f"{name}: {done}/{sequences} sequences", file=sys.stderr, flush=True)
