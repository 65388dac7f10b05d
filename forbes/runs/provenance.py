"""Provenance of a run: command, time, machine, versions and data."""

import hashlib
import os
import platform
import shlex
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

import forbes
from forbes.errors import ForbesError
from forbes.reading import read_json
from forbes.runs.configuration import allowed_modules

__all__ = ["code_sha256", "command_line", "commit", "describe_start", "origin", "read_provenance"]

PACKAGES = ("torch", "lightning", "jsonargparse", "numpy", "dm-control", "mujoco", "gymnasium")
"""Packages that may change the results of a run; gymnasium is optional."""


def read_provenance(path: Path) -> list[dict[str, Any]]:
    """Read provenance.json.

    Raises:
        ForbesError: if it is not a list of entries.
    """
    remedy = "Move it out of the run folder, and repeat the command"
    entries = read_json(path, remedy)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ForbesError(f"{path}: expected a list with one entry per start. {remedy}")
    return entries


def describe_start(arguments: Sequence[str]) -> dict[str, Any]:
    """Return command, time, commit, versions and machine."""
    return {
        "command": command_line(*arguments),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "versions": _versions(),
        "machine": {
            "name": platform.node(),
            "system": platform.platform(),
            "cpus": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        },
    }


def _versions() -> dict[str, str]:
    versions = {"forbes": forbes.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def command_line(*arguments: str) -> str:
    """Return the command line to repeat a command, with the `--allow-module` flags of this process."""
    return shlex.join(["forbes", *allowed_modules(), *arguments])


def origin(command: str, seed: int) -> dict[str, Any]:
    """Return command, commit, random seed and date, for the record of a result."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"command": command, "commit": commit(), "seed": seed, "date": date}


@cache
def code_sha256() -> str:
    """Return a hash of this package's modules: of what is installed, or of a checkout with its changes."""
    found = hashlib.sha256()
    for path in sorted(Path(forbes.__file__).parent.rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


def commit() -> str | None:
    """Return the commit of this checkout, with +dirty if files are changed; None outside a git checkout."""
    root = Path(forbes.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    git = ["git", "-C", str(root)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+dirty" if changes.stdout.strip() else "")
