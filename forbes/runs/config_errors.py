"""Errors of the configuration: turn jsonargparse's messages into one sentence with the nearest valid name."""

import argparse
import difflib
import inspect
import itertools
import pydoc
import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from torch import nn

from forbes.data import SequenceSource
from forbes.errors import ForbesError
from forbes.reading import shortened

__all__ = ["building", "one_sentence", "raised_inside", "said_by_lightning"]

_LENGTH = 200  # characters of a message; the libraries' own may contain a whole configuration

TOP_LEVEL = ("model", "data", "trainer", "seed_everything", "config", "ckpt_path")


class _Complaint(NamedTuple):
    """What is wrong with a configuration."""

    key: str
    """Key of the configuration, or empty."""
    sentence: str
    file: str = ""
    """File that the sentence is about, if it is not about a key."""


def one_sentence(message: str, arguments: Sequence[str] = ()) -> str:
    """Return one sentence that says where a configuration is wrong, and what to write instead.

    Args:
        message: message of jsonargparse, with many lines about nested types.
        arguments: command line, to distinguish a wrong flag from a wrong line in a file.
    """
    key, sentence, file = _complaint(message, re.findall(r'Parser key "([\w.]+)"', message))
    if file:
        return f"{file}: {sentence}"
    return f"{_place(key, arguments)}{key + ': ' if key else ''}{shortened(sentence, _LENGTH)}"


def _complaint(message: str, keys: list[str]) -> _Complaint:
    """Explain a message by the first rule that matches, or as a wrong value."""
    for pattern, explain in _RULES:
        if match := re.search(pattern, message):
            return explain(match, message, keys)
    return _Complaint(".".join(keys), _wrong_value(message))


def _surplus_word(match: re.Match[str], message: str, keys: list[str]) -> _Complaint:
    return _Complaint(
        "", "is not a flag. Configurations come first: forbes fit CONFIG [CONFIG ...] [--KEY VALUE ...]", match[1]
    )


def _missing_argument(match: re.Match[str], message: str, keys: list[str]) -> _Complaint:
    """Explain a missing argument of a class, or a missing configuration."""
    key = ".".join(keys)
    remedy = (
        f"give it: --{key}.{match[1]} VALUE" if key else "name a configuration first, e.g. forbes fit strokes/forbes"
    )
    return _Complaint(key, f"{match[1]} missing, {remedy}")


def _unknown_option(match: re.Match[str], message: str, keys: list[str]) -> _Complaint:
    """Explain an option that a class, the trainer or the configuration does not have."""
    option = match[1] or match[2]
    if group := re.search(r"Group '(\w+)'", message):
        keys = [group[1], *keys]
    path = [*keys, *option.removesuffix(".class_path").split(".")]
    owners = re.findall(r"class_path[= ]'([\w.]+)'", message)
    if owners and pydoc.locate(owners[-1]) is None:  # a short name, with arguments that are not in init_args
        sentence = f"{owners[-1]}: expected init_args next to class_path, found {option.split('.')[0]}"
        return _Complaint(".".join(keys), sentence)
    if owners:
        owner, valid = owners[-1].rpartition(".")[2], list(inspect.signature(pydoc.locate(owners[-1])).parameters)  # type: ignore[arg-type]
    elif path[0] == "trainer":
        owner, valid = "Trainer", list(inspect.signature(_sections()["trainer"]).parameters)
    else:
        return _Complaint(path[0], f"the configuration has no such option{_nearest_of_all(path[0])}")
    return _Complaint(".".join(path), f"{owner} has no such option{_nearest(path[-1], valid)}")


def _unknown_class(match: re.Match[str], message: str, keys: list[str]) -> _Complaint:
    """Explain a class that does not exist, or has the wrong type."""
    name = match[1] or match[2] or "''"
    nearest = _nearest(name, sorted(_class_names() - {name}))
    return _Complaint(".".join(keys), f"no class {name} that fits here{nearest}")


def _untrusted_class(match: re.Match[str], message: str, keys: list[str]) -> _Complaint:
    module = match[1].rpartition(".")[0]
    sentence = f"{match[1]} is not a class of forbes or Lightning. If you trust it, add: --allow-module {module}"
    return _Complaint(".".join(keys), sentence)


_RULES: tuple[tuple[str, Callable[[re.Match[str], str, list[str]], _Complaint]], ...] = (
    (r"unrecognized arguments: ([^-\s]\S*)", _surplus_word),
    (r"[Oo]ption '([\w.]+)'|unrecognized arguments: --([\w.]+)", _unknown_option),
    (r"Expected a dot import path string: (\S*)|has no attribute '(\w+)'", _unknown_class),
    (r"Importing '([\w.]+)' is not allowed", _untrusted_class),
    (r"arguments are required: ([\w., ]+)", _missing_argument),
)
"""Patterns in the messages of jsonargparse 4.53, and the functions that explain them."""


def _sections() -> dict[str, type]:
    """Return the class of each section of a configuration."""
    from lightning import LightningModule, Trainer

    from forbes.data import SequenceDataModule

    return {"data.source": SequenceSource, "data": SequenceDataModule, "trainer": Trainer, "model": LightningModule}


def _nearest_of_all(option: str) -> str:
    """Suggest the nearest option of the whole configuration, by its last part."""
    places = {name: f"{section}.{name}" for section, kind in _sections().items() for name in _arguments(kind)}
    places |= {name: name for name in TOP_LEVEL}
    near = difflib.get_close_matches(option, places, n=1)
    return f", did you mean {places[near[0]]}?" if near else _nearest(option, TOP_LEVEL)


def _arguments(kind: type) -> set[str]:
    """Return the arguments of a class and of its subclasses in forbes."""
    ours = [derived for derived in _derived([kind]) if derived is kind or derived.__module__.startswith("forbes.")]
    return {name for derived in ours for name in inspect.signature(derived).parameters}


def _class_names() -> set[str]:
    """Return the names of the classes that a configuration may use."""
    from lightning import Callback, LightningDataModule
    from lightning.pytorch.loggers import Logger

    found = _derived((nn.Module, LightningDataModule, SequenceSource, Callback, Logger))
    return {kind.__name__ for kind in found if kind.__module__.split(".")[0] != "torch" and kind.__name__[0] != "_"}


def _derived(kinds: Sequence[type]) -> set[type]:
    """Return classes and all their subclasses."""
    found: set[type] = set()
    pending = list(kinds)
    while pending:
        kind = pending.pop()
        if kind not in found:
            found.add(kind)
            pending += kind.__subclasses__()
    return found


def _nearest(word: str, valid: Sequence[str]) -> str:
    """Suggest the nearest valid name, or list all names if there are at most ten."""
    near = difflib.get_close_matches(word, valid, n=1)
    if near:
        return f", did you mean {near[0]}?"
    return f". It has {', '.join(valid)}" if len(valid) <= 10 else ""


def _wrong_value(message: str) -> str:
    """Return the given and the expected value; keep other messages of the library as they are."""
    expected = re.search(r"Expected a (.+?)\. Got value: ([^\n]+?)(?:\. Got value|\n|$)", message)
    if expected is None and "Subtypes" in message:
        expected = re.search(r"Subtypes: \[(.+?)\]\n.*Given value: ([^\n]*)", message, re.DOTALL)
    if expected is None:
        return " ".join(message.replace('in "<unicode string>", line', "at line").split())
    kind = re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", expected[1]).replace("typing.Literal", "one of ")
    return f"is {shortened(expected[2], 80)}, expected {kind.replace(', NoneType', ' or null')}"


def _place(key: str, arguments: Sequence[str]) -> str:
    """Return the configuration file of a wrong key, or nothing if a flag is wrong."""
    flags = [argument.split("=")[0].replace(".init_args", "") for argument in arguments if argument.startswith("--")]
    if key and f"--{key}" in flags:
        return ""
    configs = [value for flag, value in itertools.pairwise(arguments) if flag == "--config"]
    word = re.compile(rf"\b{re.escape(key.rpartition('.')[2])}\b")
    for config in configs[::-1]:
        if len(configs) == 1 or word.search(Path(config).read_text(errors="replace")):
            return f"{config}: "
    return ""


def raised_inside(error: BaseException) -> ForbesError | None:
    """Return the `ForbesError` in the chain of causes of an error that jsonargparse raises, if there is one."""
    inner: BaseException | None = error
    while inner is not None and not isinstance(inner, ForbesError):
        inner = inner.__cause__
    return inner


@contextmanager
def building(where: str) -> Iterator[None]:
    """Turn an error in the constructor of a configured class into one sentence.

    Args:
        where: name of the configuration.

    Raises:
        ForbesError: with the message of the class or of Lightning, or the type of the error.
    """
    try:
        yield
    except (argparse.ArgumentError, OSError):  # handled by the caller
        raise
    except Exception as error:
        if inner := raised_inside(error):
            raise inner from None
        cause = f"{type(error).__name__}: {shortened(str(error), 120)}"
        said = said_by_lightning(error) or f"{where}: cannot be instantiated ({cause}). Change it; see --debug"
        raise ForbesError(said) from error


def said_by_lightning(error: BaseException) -> str | None:
    """Return the message of an error that was raised by Lightning itself because of wrong usage, else None."""
    while error.__cause__ is not None:
        error = error.__cause__
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    if not frames or not frames[-1].f_globals["__name__"].startswith("lightning."):
        return None
    return " ".join(str(error).split())
