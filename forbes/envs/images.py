"""Images of any layout as uint8 `(C, H, W)`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["CHANNELS", "RENDERED_SIZE", "to_image"]

CHANNELS = (1, 3, 4)
"""Possible numbers of channels of an image."""

RENDERED_SIZE = 64
"""Side of a rendered image in pixels, unless another is chosen."""


def to_image(pixels: Any, size: int | None = None) -> NDArray[np.uint8]:
    """Return pixels `(H, W)`, `(H, W, C)` or `(C, H, W)` as uint8 `(C, H, W)`.

    Args:
        pixels: image, uint8.
        size: side of the result in pixels, resized by averaging; None keeps the original size.
    """
    image = np.atleast_3d(pixels)  # (H, W, C) or (C, H, W)
    if image.shape[-1] in CHANNELS:
        image = image.transpose(2, 0, 1)  # (C, H, W)
    if size is not None and image.shape[1:] != (size, size):
        from PIL import Image

        small = (Image.fromarray(channel).resize((size, size), Image.Resampling.BOX) for channel in image)
        image = np.stack([np.asarray(channel) for channel in small])  # (C, size, size)
    return np.ascontiguousarray(image)
