"""Which keys of recorded episodes become the observation, the action and the reward."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from forbes.data.imports.reader import Field, Reader
from forbes.errors import ForbesError

__all__ = ["Keys", "choose_keys"]

_ONE = "A store holds one image or one vector per step"


class Keys(NamedTuple):
    """Keys by what they become."""

    image: str | None
    proprio: tuple[str, ...]
    action: str
    reward: str | None

    @property
    def observation(self) -> tuple[str, ...]:
        """Keys of the observation."""
        return (self.image,) if self.image is not None else self.proprio

    def all(self) -> list[str]:
        """Return all keys that are read."""
        return [*self.observation, self.action, *([self.reward] if self.reward is not None else [])]


def choose_keys(
    where: str,
    reader: Reader,
    fields: Mapping[str, Field],
    image: str | None = None,
    proprio: Sequence[str] = (),
    action: str | None = None,
    reward: str | None = None,
) -> Keys:
    """Choose keys: the given ones, otherwise those with the usual names.

    Args:
        where: name of the source, for messages.
        reader: the format, which knows the usual names.
        fields: what there is.
        image: key of an image.
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
        ("--image", image),
        *(("--proprio", k) for k in proprio),
    ):
        if key is not None and key not in fields:
            raise ForbesError(f"{where}: {option} {key}: no such key. There are {_listed(fields)}")
    if image is not None and proprio:
        raise ForbesError(f"{where}: --image {image} and --proprio {proprio[0]} exclude each other. {_ONE}")
    if image is not None and not fields[image].is_image:
        found = f"{fields[image].dtype} {fields[image].shape}"
        raise ForbesError(f"{where}: --image {image} is {found}, expected uint8 (H, W, C) or (C, H, W)")
    for key in (action, *([reward] if reward else ()), *proprio):
        if fields[key].dtype.kind not in "biuf":
            raise ForbesError(f"{where}: {key} has dtype {fields[key].dtype}, expected numbers")
    if image is None and not proprio:
        known = {action, reward, *reader.actions, *reader.rewards, *reader.bookkeeping}
        others = {key: field for key, field in fields.items() if key not in known}
        image, proprio = _observation(where, reader, others)
    return Keys(image, tuple(proprio), action, reward)


def _observation(where: str, reader: Reader, fields: Mapping[str, Field]) -> tuple[str | None, tuple[str, ...]]:
    """Return the image or the vector if there is only one, or one that holds everything by convention."""
    whole = _usual(reader.observations, fields)
    images = [key for key, field in fields.items() if field.is_image]
    vectors = [key for key, field in fields.items() if field.is_vector]
    if whole in images or (len(images), len(vectors)) == (1, 0):
        return whole if whole in images else images[0], ()
    if whole in vectors or (len(images), len(vectors)) == (0, 1):
        return None, (whole or vectors[0],)
    if not images and not vectors:
        raise ForbesError(f"{where}: no key has an image (uint8) or a vector. There are {_listed(fields)}")
    choices = [f"{option} {key}" for option, keys in (("--image", images), ("--proprio", vectors)) for key in keys]
    raise ForbesError(
        f"{where}: several observations. {_ONE}; choose {' or '.join(choices)} (several vectors are joined)"
    )


def _usual(names: Iterable[str], fields: Mapping[str, Field]) -> str | None:
    return next((name for name in names if name in fields), None)


def _any(names: Sequence[str]) -> str:
    return " or ".join(names)


def _listed(fields: Mapping[str, Field]) -> str:
    return ", ".join(sorted(fields)) or "none"
