"""What recorded episodes have, and what becomes of it: the table that is shown before an import."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode
from forbes.data.imports.source import Source
from forbes.factors import described_sizes
from forbes.shapes import Observed

__all__ = ["SAMPLE", "Survey", "survey"]

SAMPLE = 20
"""Number of episodes whose numbers the table is about."""
_LEADS = "index t has {} that led to o_t, as in a store"
_FOLLOWS = "index t has {} after o_t: shifted by one, so that index t has what led to o_t"


class Survey(NamedTuple):
    """A table of the keys, and facts about the episodes."""

    rows: list[tuple[str, str, str, str, str]]
    """Key, what it becomes, shape per step, dtype, and range in the first episodes (empty if it is not used)."""
    facts: dict[str, str]


class _Seen:
    """What is known of the first episodes, of which one is in memory at a time.

    Args:
        source: their source.
    """

    def __init__(self, source: Source) -> None:
        self.ranges: dict[str, tuple[float, float]] = {}
        """Least and greatest number of each used key."""
        self.lengths: list[int] = []
        self.terminated = 0
        for number in range(min(SAMPLE, len(source))):
            episode = source.episode(number)
            for key, values in _values(source, episode).items():
                least, most = self.ranges.get(key, (math.inf, -math.inf))
                self.ranges[key] = min(least, values.min()), max(most, values.max())
            self.lengths.append(len(episode.reward) - 1)
            self.terminated += episode.terminated


def survey(source: Source) -> Survey:
    """Describe a source, with the ranges of its first `SAMPLE` episodes."""
    seen, used = _Seen(source), _used(source)
    ranges = {key: f"{least:g} to {most:g}" for key, (least, most) in seen.ranges.items()}
    rows = [
        (key, used.get(key, "not used"), str(shape), str(dtype), ranges.get(key, ""))
        for key, (shape, dtype) in source.fields.items()
    ]
    order = ["observation", "action", "reward", "not"]
    return Survey(sorted(rows, key=lambda row: order.index(row[1].partition(" ")[0])), _facts(source, seen))


def _used(source: Source) -> dict[str, str]:
    """Return what each used key becomes."""
    keys, parts = source.keys, source.keys.parts()
    used = {keys.action: "action"} | ({} if keys.reward is None else {keys.reward: "reward"})
    for part, of_part in parts.items():
        used |= dict.fromkeys(of_part, f"observation {part}" if len(parts) > 1 else "observation")
    return used


def _values(source: Source, episode: Episode) -> dict[str, NDArray[Any]]:
    """Return the numbers of each used key in an episode."""
    keys, parts = source.keys, source.keys.parts()
    values = {keys.action: episode.action[1:]}
    if keys.reward is not None:
        values[keys.reward] = episode.reward[1:]
    for part, of_part in parts.items():
        array, start = episode.observation[part] if len(parts) > 1 else episode.observation, 0
        for key in of_part:
            size = int(np.prod(source.fields[key].shape, dtype=int))
            values[key] = array if key in keys.images else array[:, start : start + size]
            start += size
    return values


def _facts(source: Source, seen: _Seen) -> dict[str, str]:
    reader, first, lengths = source.reader, source.first, seen.lengths
    of_sample = "" if len(lengths) == len(source) else f" (of the first {len(lengths)})"
    steps = f"{min(lengths)} to {max(lengths)} steps"
    facts = {
        "format": reader.name,
        "episodes": f"{len(source)}, of {steps}, {seen.terminated} terminated{of_sample}",
        "observation": _arrays(first.observation),
        "action": f"float32 {first.action.shape[1:]}, {_kind(source, *seen.ranges[source.keys.action])}",
        "alignment": _alignment(source),
    }
    if source.drops_last:
        facts["last step"] = "dropped: the observation after the last action of an episode is not recorded"
    if source.keys.reward is None:
        facts["reward"] = "0 in all steps, since no key has it (--reward KEY)"
    if source.every > 1:
        facts["steps"] = f"every {source.every}th; the {source.every} actions of a step are joined, its rewards summed"
    if reader.note:
        facts["note"] = reader.note
    return facts


def _arrays(observation: Observed) -> str:
    """Return dtype and shape of an observation, or of each part."""
    if isinstance(observation, dict):
        return ", ".join(f"{name} {_arrays(observation[name])}" for name in sorted(observation))
    return f"{observation.dtype} {observation.shape[1:]}"


def _alignment(source: Source) -> str:
    """Return how actions and rewards are moved."""
    reader = source.reader
    if source.keys.reward is None or reader.actions_lead == reader.rewards_lead:
        what = "the action" if source.keys.reward is None else "the action and reward"
        return (_LEADS if reader.actions_lead else _FOLLOWS).format(what)
    return f"{_FOLLOWS.format('the action')}; it has the reward that came with o_t, as in a store"


def _kind(source: Source, least: float, most: float) -> str:
    if source.sizes:
        return described_sizes(source.sizes)
    if max(-least, most) > 1:
        return "beyond [-1, 1] and kept as it is: an agent here would act within [-1, 1]"
    return "within [-1, 1]"
