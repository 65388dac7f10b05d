"""Which keys of recorded episodes become the observation, the action and the reward."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from forbes.data.imports.reader import Field, Reader
from forbes.errors import ForbesError
from forbes.shapes import part_name

__all__ = ["Keys", "choose_keys"]

PROPRIO = "proprio"
"""Name of the part that several joined vectors become."""


class Keys(NamedTuple):
    """Keys by what they become."""

    images: tuple[str, ...]
    proprio: tuple[str, ...]
    action: str
    reward: str | None

    @property
    def observation(self) -> tuple[str, ...]:
        """Keys of the observation."""
        return self.images + self.proprio

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return the keys of each part of the observation by its name: each image, and the vectors joined.

        A name is the last word of the key, or all of the key where the word is that of another.
        """
        several = [(PROPRIO, self.proprio)] if len(self.proprio) > 1 else []
        named = [*((key, (key,)) for key in self.images + self.proprio[: 1 - len(several)]), *several]
        last = [part_name(re.split("[./]", name)[-1]) for name, _ in named]
        return {
            word if last.count(word) == 1 else part_name(name): keys
            for word, (name, keys) in zip(last, named, strict=True)
        }

    def all(self) -> list[str]:
        """Return all keys that are read."""
        return [*self.observation, self.action, *([self.reward] if self.reward is not None else [])]


def choose_keys(
    where: str,
    reader: Reader,
    fields: Mapping[str, Field],
    images: Sequence[str] = (),
    proprio: Sequence[str] = (),
    action: str | None = None,
    reward: str | None = None,
) -> Keys:
    """Choose keys: the given ones, otherwise those with the usual names.

    Args:
        where: name of the source, for messages.
        reader: the format, which knows the usual names.
        fields: what there is.
        images: keys of images. Several, or images and vectors, are the parts of an observation.
        proprio: keys of vectors, which are concatenated.
        action: key of the action.
        reward: key of the reward. If there is none, all rewards are 0.

    Raises:
        ForbesError: if a key is missing or has another kind, or the observation is not unique. The message lists the
            keys to choose from.
    """
    action = action or _usual(reader.actions, fields)
    if action is None:
        raise ForbesError(
            f"{where}: no key {_any(reader.actions)}. Name the action: --action KEY, of {_listed(fields)}"
        )
    reward = reward or _usual(reader.rewards, fields)
    for option, key in (
        ("--action", action),
        ("--reward", reward),
        *(("--image", key) for key in images),
        *(("--proprio", k) for k in proprio),
    ):
        if key is not None and key not in fields:
            raise ForbesError(f"{where}: {option} {key}: no such key. There are {_listed(fields)}")
    for key in images:
        if not fields[key].is_image:
            found = f"{fields[key].dtype} {fields[key].shape}"
            raise ForbesError(f"{where}: --image {key} is {found}, expected uint8 (H, W, C) or (C, H, W)")
        if key in proprio:
            raise ForbesError(f"{where}: --image {key} and --proprio {key} are the same key. Leave one out")
    for key in (action, *([reward] if reward else ()), *proprio):
        if fields[key].dtype.kind not in "biuf":
            raise ForbesError(f"{where}: {key} has dtype {fields[key].dtype}, expected numbers")
    if not images and not proprio:
        known = {action, reward, *reader.actions, *reader.rewards, *reader.bookkeeping}
        others = {key: field for key, field in fields.items() if key not in known}
        images, proprio = _observation(where, reader, others)
    return Keys(tuple(images), tuple(proprio), action, reward)


def _observation(where: str, reader: Reader, fields: Mapping[str, Field]) -> tuple[Sequence[str], Sequence[str]]:
    """Return the image or the vector if there is only one, or one that holds everything by convention."""
    whole = _usual(reader.observations, fields)
    images = [key for key, field in fields.items() if field.is_image]
    vectors = [key for key, field in fields.items() if field.is_vector]
    if whole in images or (len(images), len(vectors)) == (1, 0):
        return [whole or images[0]], []
    if whole in vectors or (len(images), len(vectors)) == (0, 1):
        return [], [whole or vectors[0]]
    if not images and not vectors:
        raise ForbesError(f"{where}: no key has an image (uint8) or a vector. There are {_listed(fields)}")
    choices = [f"{option} {' '.join(keys)}" for option, keys in (("--image", images), ("--proprio", vectors)) if keys]
    raise ForbesError(
        f"{where}: several observations. Choose some of {' '.join(choices)}; each image becomes a part, and vectors "
        "are joined to one"
    )


def _usual(names: Iterable[str], fields: Mapping[str, Field]) -> str | None:
    return next((name for name in names if name in fields), None)


def _any(names: Sequence[str]) -> str:
    return " or ".join(names)


def _listed(fields: Mapping[str, Field]) -> str:
    return ", ".join(sorted(fields)) or "none"
