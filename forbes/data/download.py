"""Download, verify and locate data that are not part of the package.

This includes the learning curves of danijar/dreamer and danijar/dreamerv3 on the DeepMind Control Suite (MIT licence).
"""

import hashlib
import http
import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from forbes.errors import ForbesError
from forbes.files import append_whole, replace_file

__all__ = ["CURVES", "Curves", "curves_paths", "data_folder", "download", "fetch_curves", "git_blob_id"]

_DOWNLOAD_LIMIT = 100 * 2**20  # bytes; GitHub stores no larger file
_CHUNK = 2**16


class Curves(NamedTuple):
    """A published file of learning curves on the DeepMind Control Suite: returns against env steps."""

    name: str
    """Name of the file where it is stored."""
    url: str
    blob: str
    """Git blob id of its content."""


CURVES = (
    # Dreamer: 20 tasks with 5 seeds each, up to 4.9 million env steps
    Curves(
        "dreamer-curves.json",
        "https://github.com/danijar/dreamer/raw/master/scores/dreamer.json",
        "ab35b223497127c8eb4cf1b17db7afd4389c4faf",
    ),
    # DreamerV3, from pixels: 20 tasks with 10 seeds each, up to a million env steps
    Curves(
        "dreamerv3-curves.json.gz",
        "https://github.com/danijar/dreamerv3/raw/2411f7d136832378c0291c587cdbf2fca6506873/scores/dmc_vision-dreamerv3.json.gz",
        "bb501624a6da2509912f787d715afba564d6d45f",
    ),
)

_LOCAL = "Give a local copy with: forbes data fetch curves --from PATH"


def data_folder() -> Path:
    """Return the folder of downloaded data: `$FORBES_DATA`, or the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "forbes"
    return Path(os.environ.get("FORBES_DATA") or cache)


def download(url: str, path: Path, remedy: str) -> None:
    """Download a file. An interrupted download is resumed.

    Args:
        url: address of the file.
        path: file to write. Until it is complete, the data are in `PATH.part` in the same folder.
        remedy: what to do if it cannot be downloaded, for the error message.

    Raises:
        ForbesError: if the file cannot be downloaded, is interrupted, or is larger than any file on GitHub.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        held = part.stat().st_size if part.exists() else 0
        request = urllib.request.Request(url, headers={"Range": f"bytes={held}-"} if held else {})
        with urllib.request.urlopen(request, timeout=30) as response:
            _receive(response, part, url, remedy)
    except urllib.error.HTTPError as error:
        error.close()
        if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:  # nothing is left to send
            raise ForbesError(f"{url}: could not be downloaded ({error}). {remedy}") from error
    except (OSError, http.client.HTTPException) as error:
        raise ForbesError(f"{url}: could not be downloaded ({getattr(error, 'reason', error)}). {remedy}") from error
    part.replace(path)


def _receive(response: http.client.HTTPResponse, part: Path, url: str, remedy: str) -> None:
    """Write the body of a response, appended to the partial file if the server agreed to resume."""
    resumed = response.status == http.HTTPStatus.PARTIAL_CONTENT
    announced = response.headers["Content-Length"]
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    held = part.stat().st_size if resumed else 0
    if not resumed:
        part.unlink(missing_ok=True)
    append_whole(part, b"")  # create the file even if nothing is received
    with Progress(*columns) as progress:
        total = held + int(announced) if announced else None
        task = progress.add_task(url.rpartition("/")[2], total=total, completed=held)
        while chunk := response.read(_CHUNK):
            append_whole(part, chunk)
            held += len(chunk)
            progress.update(task, completed=held)
            if held > _DOWNLOAD_LIMIT:
                raise ForbesError(f"{url}: sends more than {_DOWNLOAD_LIMIT} bytes, expected a smaller file. {remedy}")
        if total is not None and held < total:
            raise ForbesError(f"{url}: interrupted after {held} of {total} bytes. Run it again to resume.")


def git_blob_id(path: Path) -> str:
    """Return the git blob id of a file: the SHA-1 of `blob <size>`, a zero byte and the content."""
    digest = hashlib.sha1(b"blob %d\0" % path.stat().st_size, usedforsecurity=False)
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def curves_paths() -> list[Path]:
    """Return the paths of the downloaded curves, those of Dreamer first."""
    return [data_folder() / curves.name for curves in CURVES]


def fetch_curves(source: Path | None, folder: Path) -> Iterator[tuple[Path, bool]]:
    """Download the curves that are not stored yet, or copy a file of them, and verify them.

    Args:
        source: local copy of one of the files; None downloads all.
        folder: where to write each file, complete or not at all.

    Yields:
        The path of a stored file, and whether it is new.

    Raises:
        ForbesError: if a file cannot be downloaded, or its hash is wrong.
    """
    if source is not None:
        yield _copy_curves(source, folder), True
        return
    for curves in CURVES:
        path = folder / curves.name
        if path.is_file() and git_blob_id(path) == curves.blob:
            yield path, False
        else:
            new = path.with_name(f"{path.name}.new")
            download(curves.url, new, _LOCAL)
            if (found := git_blob_id(new)) != curves.blob:
                new.unlink()
                raise ForbesError(f"{curves.url}: the git blob id is {found}, expected {curves.blob}. {_LOCAL}")
            new.replace(path)
            yield path, True


def _copy_curves(source: Path, folder: Path) -> Path:
    """Copy a file of curves to its name."""
    if not source.is_file():
        raise ForbesError(f"{source}: no such file. {_LOCAL}")
    found, names = git_blob_id(source), {curves.blob: curves.name for curves in CURVES}
    if found not in names:
        raise ForbesError(f"{source}: the git blob id is {found}, expected {' or '.join(names)}. {_LOCAL}")
    replace_file(folder / names[found], source.read_bytes())
    return folder / names[found]
