"""Arguments of a model as plain values, so that a checkpoint can store them without pickling."""

import argparse
import inspect
from collections.abc import Mapping
from functools import partial
from numbers import Integral, Real
from typing import Any

from lightning.pytorch.cli import LightningArgumentParser

from forbes.errors import ForbesError
from forbes.models import Likelihood
from forbes.runs.config_errors import building, one_sentence
from forbes.runs.configuration import allow_modules, require_classes

__all__ = ["build_arguments", "plain_arguments"]


def plain_arguments(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments as in config.yaml: a class with options becomes its `class_path` and `init_args`."""
    return {name: _plain(value) for name, value in arguments.items()}


def build_arguments(kind: type, plain: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the constructor's arguments for plain arguments: the inverse of `plain_arguments`.

    Args:
        kind: class to construct.
        plain: some of its arguments by name, as plain values.
        where: file of the arguments, for error messages.

    Raises:
        ForbesError: for an argument that the class does not have, or a class that a configuration may not use.
    """
    allow_modules()
    others = {*inspect.signature(kind).parameters} - {*plain}
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_class_arguments(kind, "model", instantiate=False, skip=others)
    try:
        with building(where):
            parsed = parser.parse_object({"model": dict(plain)})
    except argparse.ArgumentError as error:
        raise ForbesError(f"{where}: {one_sentence(str(error))}") from error
    require_classes(parsed)
    with building(where):
        return vars(parser.instantiate(parsed).model) if plain else {}


def _plain(value: Any) -> Any:
    """Return one argument: numbers and strings unchanged, tuples as lists, anything else by the name of its class.

    Values without an importable name, such as a lambda, are refused by `build_arguments`, and must be passed again.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, Real):  # includes numpy's
        return int(value) if isinstance(value, Integral) else float(value)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return plain_arguments(value)
    if isinstance(value, partial):
        return {"class_path": _path(value.func), "init_args": plain_arguments(value.keywords)}
    if isinstance(value, Likelihood):
        names = [name for name in inspect.signature(type(value)).parameters if hasattr(value, name)]
        options = {name: getattr(value, name) for name in names}
        return {"class_path": _path(type(value)), "init_args": plain_arguments(options)}
    return {"class_path": _path(value if hasattr(value, "__qualname__") else type(value))}


def _path(kind: Any) -> str:
    """Return the import path of a class or a function."""
    return f"{kind.__module__}.{kind.__qualname__}"
