"""Configurations by name: `strokes/forbes` is the file of the package, unless there is a file of that name."""

import difflib
import itertools
from collections.abc import Sequence
from pathlib import Path

from forbes.bundled import shipped
from forbes.errors import ForbesError

__all__ = ["config_folder", "find_config", "shipped_configs", "with_config_paths"]

_FLAGS = ("--config", "-c")


def config_folder() -> Path:
    """Return the folder of the package's configurations: `forbes/configs/` of a wheel, `configs/` of a checkout."""
    return shipped("configs")


def shipped_configs() -> dict[str, Path]:
    """Return the configurations of the package: each file by its name, sorted, folder by folder."""
    folder = config_folder()
    files = sorted(folder.rglob("*.yaml"), key=lambda path: (path.parent, path.name))
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in files}


def find_config(name: str) -> Path:
    """Return the file of a configuration.

    Args:
        name: path of a file, or name of a configuration of the package. If both exist, the file is used.

    Raises:
        ForbesError: if there is neither.
    """
    path = Path(name)
    if path.exists() and not path.is_dir():  # a pipe is not a file
        return path
    files = shipped_configs()
    if name not in files:
        raise ForbesError(f"{name}: no such configuration.{_nearest(name, list(files))} List all: forbes configs")
    return files[name]


def with_config_paths(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of `forbes fit` with `--config PATH` for each configuration, however it is given.

    `strokes/forbes debug --seed_everything 1` becomes `--config PATH --config PATH --seed_everything 1`. Names come
    before the first flag, or follow `--config`.

    Raises:
        ForbesError: if there is no such configuration.
    """
    names = list(itertools.takewhile(lambda argument: not argument.startswith("-"), arguments))
    found = [part for name in names for part in ("--config", str(find_config(name)))]
    rest = iter(arguments[len(names) :])
    for argument in rest:
        flag, given, name = argument.partition("=")
        if flag in _FLAGS and (given or (name := next(rest, ""))):
            found += ["--config", str(find_config(name))]
        else:
            found.append(argument)
    return found


def _nearest(name: str, known: Sequence[str]) -> str:
    """Suggest up to three names: those with the same last part, else those that are spelled alike."""
    asked = name.removeprefix("./").removeprefix("configs/").removesuffix(".yaml")
    near = [asked] if asked in known else sorted((s for s in known if s.endswith(f"/{asked}")), key=len)
    *others, last = (near or difflib.get_close_matches(asked, known))[:3] or [""]
    return f" Did you mean {', '.join(others)}{' or ' if others else ''}{last}?" if last else ""
