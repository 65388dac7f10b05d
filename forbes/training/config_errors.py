"""Errors of the configuration, from jsonargparse's pages to one sentence that names the nearest valid word."""

import difflib
import inspect
import itertools
import pydoc
import re
import traceback
from collections.abc import Sequence
from pathlib import Path

from lightning import Callback, LightningDataModule, Trainer
from lightning.pytorch.loggers import Logger
from torch import nn

from forbes.data import SequenceSource
from forbes.errors import ForbesError

__all__ = ["one_sentence", "raised_by_lightning", "raised_inside"]

TOP_LEVEL = ("model", "data", "trainer", "seed_everything", "config", "ckpt_path")
CONFIGURABLE = (nn.Module, LightningDataModule, SequenceSource, Callback, Logger)


def one_sentence(message: str, arguments: Sequence[str] = ()) -> str:
    """Say where a configuration is wrong, and what to write instead.

    Args:
        message: what jsonargparse says, many lines with the way through the nested types.
        arguments: of the command line, to tell a flag from a line of the file.
    """
    keys = re.findall(r'Parser key "([\w.]+)"', message)
    if found := re.search(r"[Oo]ption '([\w.]+)'|unrecognized arguments: --([\w.]+)", message):
        key, sentence = _unknown_option(message, keys, found[1] or found[2])
    elif found := re.search(r"Expected a dot import path string: (\S*)|has no attribute '(\w+)'", message):
        key, sentence = ".".join(keys), _unknown_class(found[1] or found[2])
    elif found := re.search(r"Importing '([\w.]+)' is not allowed", message):
        module = found[1].rpartition(".")[0]
        key = ".".join(keys)
        sentence = f"{found[1]} is not of forbes, lightning or torch. If you trust it, add: --allow-module {module}"
    elif found := re.search(r"arguments are required: ([\w., ]+)", message):
        key, sentence = (
            ".".join(keys),
            f"{found[1]} missing, give a configuration: --config configs/strokes/forbes.yaml",
        )
    elif found := re.search(r"File does not exist: '(.*)'", message):
        return f"{found[1]}: no such file. See configs/ for those that come with forbes"
    else:
        key, sentence = ".".join(keys), _wrong_value(message)
    return f"{_place(key, arguments)}{key + ': ' if key else ''}{sentence}"


def _unknown_option(message: str, keys: list[str], option: str) -> tuple[str, str]:
    """Name an option that a class, the trainer or the whole configuration does not have."""
    if group := re.search(r"Group '(\w+)'", message):
        keys = [group[1], *keys]
    path = [*keys, *option.removesuffix(".class_path").split(".")]
    owners = re.findall(r"class_path[= ]'([\w.]+)'", message)
    if owners:
        owner, valid = owners[-1].rpartition(".")[2], list(inspect.signature(pydoc.locate(owners[-1])).parameters)  # type: ignore[arg-type]
    elif path[0] == "trainer":
        owner, valid = "Trainer", list(inspect.signature(Trainer).parameters)
    else:
        owner, valid, path = "the configuration", list(TOP_LEVEL), path[:1]
    return ".".join(path), f"{owner} has no such option{_nearest(path[-1], valid)}"


def _unknown_class(name: str) -> str:
    """Name a class that does not exist, or exists and is of another kind."""
    return f"no class {name} that fits here{_nearest(name, sorted(_class_names() - {name}))}"


def _class_names() -> set[str]:
    """Give the names of the classes a configuration may name."""
    found: set[type] = set()
    pending = list(CONFIGURABLE)
    while pending:
        kind = pending.pop()
        if kind not in found:
            found.add(kind)
            pending += kind.__subclasses__()
    return {kind.__name__ for kind in found if kind.__module__.split(".")[0] != "torch" and kind.__name__[0] != "_"}


def _nearest(word: str, valid: Sequence[str]) -> str:
    """Suggest the nearest valid word, or give a short list whole."""
    near = difflib.get_close_matches(word, valid, n=1)
    if near:
        return f", did you mean {near[0]}?"
    return f". It has {', '.join(valid)}" if len(valid) <= 10 else ""


def _wrong_value(message: str) -> str:
    """Say which value was given and what was expected; keep the library's words where they are short already."""
    expected = re.search(r"Expected a (.+?)\. Got value: ([^\n]+?)(?:\. Got value|\n|$)", message)
    if expected is None and "Subtypes" in message:
        expected = re.search(r"Subtypes: \[(.+?)\]\n.*Given value: ([^\n]*)", message, re.DOTALL)
    if expected is None:
        return " ".join(message.replace('in "<unicode string>", line', "at line").split())
    kind = re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", expected[1]).replace("typing.Literal", "one of ")
    return f"is {expected[2]}, expected {kind.replace(', NoneType', ' or null')}"


def _place(key: str, arguments: Sequence[str]) -> str:
    """Name the configuration file, unless a flag is to blame."""
    flags = [argument.split("=")[0].replace(".init_args", "") for argument in arguments if argument.startswith("--")]
    if key and f"--{key}" in flags:
        return ""
    configs = [value for flag, value in itertools.pairwise(arguments) if flag in ("--config", "-c")]
    word = re.compile(rf"\b{re.escape(key.rpartition('.')[2])}\b")
    for config in configs[::-1]:
        if len(configs) == 1 or word.search(Path(config).read_text()):
            return f"{config}: "
    return ""


def raised_inside(error: BaseException) -> ForbesError | None:
    """Find the error of ours that a constructor has raised, under what jsonargparse makes of it."""
    inner: BaseException | None = error
    while inner is not None and not isinstance(inner, ForbesError):
        inner = inner.__cause__
    return inner


def raised_by_lightning(error: BaseException) -> bool:
    """Tell whether Lightning itself has raised an error: its message is then about how it was used."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals["__name__"]).startswith("lightning.")
