"""Stroke sets of a few given paths, and the first ten MNIST test images."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from forbes.data.strokes.file import StrokeArrays

# The same examples in every run, and no failure because the machine is busy.
settings.register_profile("strokes", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("strokes")


@pytest.fixture(scope="session")
def make_arrays():
    """Make `StrokeArrays` of digits, each a list of strokes, each a list of pixels."""

    def make(*digits):
        strokes = [stroke for digit in digits for stroke in digit]
        points = np.array([pixel for stroke in strokes for pixel in stroke], np.uint8)
        pen_up = np.zeros(len(points), bool)
        pen_up[np.cumsum([len(stroke) for stroke in strokes]) - 1] = True
        offsets = np.cumsum([0, *(sum(map(len, digit)) for digit in digits)]).astype(np.int32)
        return StrokeArrays(points, pen_up, offsets, np.arange(len(digits), dtype=np.uint8) % 10)

    return make


@pytest.fixture(scope="session")
def mnist_digits():
    """The first ten MNIST test images, uint8 (10, 28, 28), and their labels, uint8 (10,)."""
    with np.load(Path(__file__).with_name("mnist_test_0_to_9.npz")) as file:
        return file["images"], file["labels"]
