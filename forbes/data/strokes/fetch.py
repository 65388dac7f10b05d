"""Download the paper's stroke set, or use a local copy, and convert it to a stroke file."""

import gzip
import tarfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from forbes.data.download import download, git_blob_id
from forbes.data.strokes.dejong import parse_digit, verify_dejong
from forbes.data.strokes.file import StrokeArrays, check_strokes, load_strokes, save_strokes
from forbes.errors import ForbesError

__all__ = [
    "DEJONG_BLOB",
    "DEJONG_URL",
    "convert",
    "fetch_dejong",
    "read_archive",
    "read_folder",
    "wanted_files",
]

DEJONG_URL = "https://github.com/edwin-de-jong/mnist-digits-stroke-sequence-data/raw/master/sequences.tar.gz"
DEJONG_BLOB = "33b359bd06060e7e98abffaf74470f0b7310d12b"
DIGITS = {"train": 60_000, "test": 10_000}

_LOCAL = "Give a local copy with: forbes data fetch strokes --from PATH, or use the bundled origin"
_ARCHIVE_LIMIT = 2**30  # bytes when unpacked; the 210,000 small files and their tar headers have less than half
_DIGIT_LIMIT = 2**14  # bytes of one digit's rows; the longest digit, of 106 points, has less than 2,000
_LABELS_LIMIT = 2**20  # bytes; 60,000 lines of one character


def fetch_dejong(source: Path | None, destination: Path) -> None:
    """Download or read the paper's set, verify it, and store it as a stroke file.

    Args:
        source: tarball, its extracted folder or a converted `.npz`; None downloads the tarball.
        destination: stroke file to write. A download is stored in the same folder until it is converted.
    """
    if source is not None:
        splits = _read(source)
    else:
        tarball = destination.with_name("sequences.tar.gz")
        download(DEJONG_URL, tarball, _LOCAL)
        try:
            splits = _read(tarball)
        finally:
            tarball.unlink()  # a wrong file would not get better by resuming the download
    verify_dejong(splits, source or destination, _LOCAL)
    save_strokes(destination, splits)


def _read(source: Path) -> dict[str, StrokeArrays]:
    wanted = wanted_files(DIGITS)
    if source.is_dir():
        return convert(read_folder(source, wanted), DIGITS, source)
    if not source.is_file():
        raise ForbesError(f"{source}: no such file or folder. {_LOCAL}")
    if source.suffix == ".npz":
        return load_strokes(source, _LOCAL)
    found = git_blob_id(source)
    if found != DEJONG_BLOB:
        raise ForbesError(f"{source}: the git blob id is {found}, expected {DEJONG_BLOB}. {_LOCAL}")
    return convert(read_archive(source, wanted), DIGITS, source)


def wanted_files(digits: Mapping[str, int]) -> dict[str, int]:
    """Return the names of the files for the given number of digits of each split, with their maximal size in bytes."""
    wanted = {f"{split}labels.txt": _LABELS_LIMIT for split in digits}
    for split, number in digits.items():
        wanted |= {f"{split}img-{digit}-inputdata.txt": _DIGIT_LIMIT for digit in range(number)}
    return wanted


def read_folder(folder: Path, wanted: Mapping[str, int]) -> Iterator[tuple[str, bytes]]:
    """Read files of the extracted tarball."""
    root = folder / "sequences" if (folder / "sequences").is_dir() else folder
    for name, limit in wanted.items():
        try:
            with (root / name).open("rb") as file:
                content = file.read(limit + 1)
        except OSError as error:
            raise ForbesError(f"{root / name}: cannot be read ({error.strerror}). {_LOCAL}") from error
        _check_size(len(content), limit, root / name)
        yield name, content


def read_archive(path: Path, wanted: Mapping[str, int]) -> Iterator[tuple[str, bytes]]:
    """Read members of the tarball by their exact names, in one pass over the stream. Nothing is extracted.

    An archive is refused if it has other members than plain files and folders with relative names, if a wanted member
    is duplicate or too large, or if it unpacks to more than a gigabyte.
    """
    seen: set[str] = set()
    try:
        with _BoundedGzip(path) as unpacked, tarfile.open(fileobj=unpacked, mode="r|") as archive:
            for member in archive:
                parts = PurePosixPath(member.name).parts
                if not (member.isreg() or member.isdir()) or ".." in parts or "/" in parts:
                    raise ForbesError(
                        f"{path}: {member.name} is a link or points outside, expected plain files. {_LOCAL}"
                    )
                if parts[:-1] != ("sequences",) or parts[-1] not in wanted:
                    continue
                if parts[-1] in seen:
                    raise ForbesError(f"{path}: {member.name} occurs twice, expected once. {_LOCAL}")
                seen.add(parts[-1])
                _check_size(member.size, wanted[parts[-1]], f"{path}: {member.name}")
                content = archive.extractfile(member)
                assert content is not None  # it is a plain file
                yield parts[-1], content.read()
    except (tarfile.TarError, EOFError, OSError, ValueError, zlib.error) as error:
        raise ForbesError(f"{path}: truncated or not a gzipped tar archive ({error}). {_LOCAL}") from error


class _BoundedGzip(gzip.GzipFile):
    """A gzipped stream that raises an error beyond a size limit, against zip bombs."""

    def read(self, size: int | None = -1) -> bytes:
        """Read unpacked bytes."""
        if self.tell() > _ARCHIVE_LIMIT:
            raise ForbesError(f"{self.name}: unpacks to more than {_ARCHIVE_LIMIT} bytes, expected fewer. {_LOCAL}")
        return super().read(size)


def _check_size(size: int, limit: int, where: Path | str) -> None:
    if size > limit:
        raise ForbesError(f"{where} has more than {limit} bytes, expected fewer. {_LOCAL}")


def convert(files: Iterable[tuple[str, bytes]], digits: Mapping[str, int], where: Path) -> dict[str, StrokeArrays]:
    """Convert the text files, in any order, of the given number of digits of each split to arrays."""
    wanted = wanted_files(digits)
    paths: dict[str, tuple[NDArray[np.uint8], NDArray[np.bool_]]] = {}
    labels: dict[str, NDArray[np.uint8]] = {}
    for name, content in track(files, "Converting", total=len(wanted)):
        if name.endswith("labels.txt"):
            labels[name] = _parse_labels(content, f"{where}: {name}")
        else:
            paths[name] = parse_digit(content, f"{where}: {name}")
    missing = wanted.keys() - paths.keys() - labels.keys()
    if missing:
        raise ForbesError(f"{where}: {len(missing)} files such as {min(missing)} are missing. {_LOCAL}")
    splits = {}
    for split, number in digits.items():
        points, pen_up = zip(*(paths[f"{split}img-{digit}-inputdata.txt"] for digit in range(number)), strict=True)
        offsets = np.cumsum([0, *map(len, points)], dtype=np.int32)
        splits[split] = StrokeArrays(
            np.concatenate(points), np.concatenate(pen_up), offsets, labels[f"{split}labels.txt"]
        )
    check_strokes(splits, where, _LOCAL)
    return splits


def _parse_labels(content: bytes, where: str) -> NDArray[np.uint8]:
    try:
        return np.array(content.split(), dtype=np.uint8)
    except (ValueError, OverflowError) as error:
        raise ForbesError(f"{where}: a label is not a number ({error}), expected digits 0 to 9. {_LOCAL}") from error
