"""What recorded episodes have, and what becomes of it: the table that is shown before an import."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.data.episodes.episode import Episode
from forbes.data.imports.source import SAMPLE, Source
from forbes.factors import described_sizes
from forbes.shapes import Observed

__all__ = ["Survey", "survey"]

_LEADS = "index t has {} that led to o_t, as in a store"
_FOLLOWS = "index t has {} after o_t: shifted by one, so that index t has what led to o_t"


class Survey(NamedTuple):
    """A table of the keys, and facts about the episodes."""

    rows: list[tuple[str, str, str, str, str]]
    """Key, what it becomes, shape per step, dtype, and range in the first episodes (empty if it is not used)."""
    facts: dict[str, str]


def survey(source: Source) -> Survey:
    """Describe a source, with the ranges of its first `SAMPLE` episodes."""
    sample = [source.episode(number) for number in range(min(SAMPLE, len(source)))]
    used = _used(source, sample)
    rows = [
        (key, *used.get(key, ("not used", ""))[:1], str(shape), str(dtype), used.get(key, ("", ""))[1])
        for key, (shape, dtype) in source.fields.items()
    ]
    order = ["observation", "action", "reward", "not"]
    return Survey(sorted(rows, key=lambda row: order.index(row[1].partition(" ")[0])), _facts(source, sample))


def _used(source: Source, sample: Sequence[Episode]) -> dict[str, tuple[str, str]]:
    """Return what each used key becomes, and its range."""
    keys = source.keys
    used = {keys.action: ("action", _range([episode.action[1:] for episode in sample]))}
    if keys.reward is not None:
        used[keys.reward] = "reward", _range([episode.reward[1:] for episode in sample])
    parts = keys.parts()
    for part, of_part in parts.items():
        arrays = [episode.observation[part] if len(parts) > 1 else episode.observation for episode in sample]
        start, becomes = 0, f"observation {part}" if len(parts) > 1 else "observation"
        for key in of_part:
            size = int(np.prod(source.fields[key].shape, dtype=int))
            columns = slice(None) if key in keys.images else slice(start, start + size)
            used[key] = becomes, _range([array[:, columns] for array in arrays])
            start += size
    return used


def _facts(source: Source, sample: Sequence[Episode]) -> dict[str, str]:
    reader, first = source.reader, sample[0]
    lengths = [len(episode.reward) - 1 for episode in sample]
    of_sample = "" if len(sample) == len(source) else f" (of the first {len(sample)})"
    ended = sum(episode.terminated for episode in sample)
    facts = {
        "format": reader.name,
        "episodes": f"{len(source)}, of {min(lengths)} to {max(lengths)} steps, {ended} terminated{of_sample}",
        "observation": _arrays(first.observation),
        "action": f"float32 {first.action.shape[1:]}, {_kind(source, sample)}",
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


def _kind(source: Source, sample: Sequence[Episode]) -> str:
    if source.sizes:
        return described_sizes(source.sizes)
    if max(float(np.abs(episode.action).max()) for episode in sample) > 1:
        return "beyond [-1, 1] and kept as it is: an agent here would act within [-1, 1]"
    return "within [-1, 1]"


def _range(values: list[NDArray[Any]]) -> str:
    least, most = (function([getattr(array, function.__name__)() for array in values]) for function in (min, max))
    return f"{least:g} to {most:g}"
