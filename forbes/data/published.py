"""Get learning curves that others have published: danijar/dreamer's, of the DeepMind Control Suite (MIT licence)."""

import shutil
from pathlib import Path

from forbes.data.download import data_folder, download, git_blob_id
from forbes.errors import ForbesError

__all__ = ["CURVES_BLOB", "CURVES_URL", "curves_path", "fetch_curves"]

CURVES_URL = "https://github.com/danijar/dreamer/raw/master/scores/dreamer.json"
CURVES_BLOB = "ab35b223497127c8eb4cf1b17db7afd4389c4faf"
"""20 tasks, 5 seeds each, returns against env steps up to 4.9 million."""

_LOCAL = "Give a local copy with: forbes data fetch curves --from PATH"


def curves_path() -> Path:
    """Where they are kept."""
    return data_folder() / "dreamer-curves.json"


def fetch_curves(source: Path | None, destination: Path) -> None:
    """Store the curves, verified.

    Args:
        source: a copy of the file; None downloads it.
        destination: where it comes to lie, whole or not at all.

    Raises:
        ForbesError: where it cannot be had, or is another file.
    """
    new = destination.with_name(f"{destination.name}.new")
    if source is None:
        download(CURVES_URL, new, _LOCAL)
    elif source.is_file():
        new.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, new)
    else:
        raise ForbesError(f"{source}: there is no such file. {_LOCAL}")
    found = git_blob_id(new)
    if found != CURVES_BLOB:
        new.unlink()
        raise ForbesError(f"{source or CURVES_URL}: the git blob id is {found}, expected {CURVES_BLOB}. {_LOCAL}")
    new.replace(destination)
