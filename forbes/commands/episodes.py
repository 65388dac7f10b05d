"""`forbes data info` and `check`: describe and verify stored episodes."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from forbes.data.episodes.episode import EpisodeRecord
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.factors import as_discrete, factor_sizes
from forbes.figures.episodes import draw_strips
from forbes.figures.grids import is_image, require_images
from forbes.figures.style import save_figure
from forbes.shapes import shape_of

__all__ = ["check", "count_steps", "info"]


def info(path: Path, output: Path | None = None) -> None:
    """Print a summary of an episode store, and draw frames of three episodes.

    Args:
        path: folder of the store.
        output: image file to write. Default: `frames.png` in the folder. Only images with at most four channels are
            drawn.

    Raises:
        ForbesError: if the store is empty, or a picture is asked for and there are no images.
    """
    store = EpisodeStore(path)
    store.require_episodes()
    shape = shape_of(store.records[min(store.records)].environment["observation_shape"])
    if output is not None:
        require_images(f"-o {output}", shape, "Leave -o out")
    records = sorted(store.records.values(), key=lambda record: record.total_reward)
    for name, value in _facts(store, records):
        print(f"{name:<22}{value}")
    if is_image(shape):
        chosen = {record.number: record for record in (records[0], records[len(records) // 2], records[-1])}
        rows = [(f"episode {n}\nreturn {one.total_reward:.1f}", store.episode(n)) for n, one in chosen.items()]
        picture = output or path / "frames.png"
        save_figure(draw_strips(rows), picture)
        print(picture)


def _facts(store: EpisodeStore, records: list[EpisodeRecord]) -> list[tuple[str, str]]:
    """Return the summary as (name, value) pairs; `records` are sorted by return."""
    returns = np.array([record.total_reward for record in records])
    facts = [(name, str(value)) for name, value in records[-1].environment.items() if name != "made_by"]
    made_by = Counter(
        ", ".join(f"{name} {value}" for name, value in record.environment.get("made_by", {}).items())
        for record in records
    )
    facts += [("made by", f"{text or 'unknown'}: {count} episodes") for text, count in made_by.items()]
    policies = Counter(record.policy for record in records)
    facts += [
        ("policies", ", ".join(f"{name}: {count} episodes" for name, count in policies.items())),
        (
            "episodes",
            f"{len(records)} of {store.watermark} ever stored; {sum(r.terminated for r in records)} terminated",
        ),
        ("steps", count_steps(records)),
        ("size on disk", f"{sum(record.size for record in records) / 2**20:.1f} MiB"),
        ("return", _spread(returns)),
    ]
    rewards, actions = [], []
    for episode in map(store.episode, store.records):
        rewards.append(episode.reward[1:].copy())  # a view would keep the file open
        actions.append(episode.action[1:].copy())
    facts.append(("reward per step", _spread(np.concatenate(rewards))))
    columns = np.concatenate(actions).T  # (A, steps)
    sizes = factor_sizes(as_discrete(records[-1].environment["discrete"]), len(columns))
    names = [f"{factor} = {option}" for factor, size in enumerate(sizes) for option in range(size)]
    named = zip(names if len(sizes) > 1 else range(len(columns)), columns, strict=True)
    return facts + [(f"action {name}", _spread(column)) for name, column in named]


def check(path: Path) -> int:
    """Verify every file of an episode store, and move damaged ones to `quarantine/`. Return 1 if there were any.

    Args:
        path: folder of the store.
    """
    store = EpisodeStore(path)
    if not store.files():  # else a lost index can be rebuilt
        store.require_episodes()
    with EpisodeWriter(path) as writer:
        count, damage = len(writer.records), writer.damage()
        for number, reason in damage.items():
            writer.quarantine(number)
            print(f"{writer.file(number)}: damaged ({reason}), moved to {path / 'quarantine'}")
    print(f"{path}: {count} episodes read, {count - len(damage)} intact, {len(damage)} damaged")
    return int(bool(damage))


def count_steps(records: list[EpisodeRecord]) -> str:
    """Return the number of agent steps and of env steps, in words."""
    steps, frames = sum(record.steps for record in records), sum(record.frames for record in records)
    return f"{steps:,} agent steps, {frames:,} env steps (frames, with action repeat)"


def _spread(values: Any) -> str:
    return f"{values.min():.3f} to {values.max():.3f}, mean {values.mean():.3f}"
