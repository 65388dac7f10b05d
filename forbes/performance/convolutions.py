"""Convolutions of many frames on a CPU, as fast as it can: the layers that `forbes.models.networks` defines."""

from typing import cast

import torch
from torch import Tensor, nn

__all__ = ["convolve"]

_PIXELS = 2**19
"""Pixels of a chunk: 128 frames of 64 pixels a side. Their largest map has 16 MiB at 32 channels. The C library returns
tensors above 32 MB to the operating system, which then clears their memory again for each new one."""
_FEW = 16
"""For fewer frames, as when an agent acts, weights take longer to reorder than the frames save."""


def convolve(layers: nn.Sequential, maps: Tensor, pixels: int) -> Tensor:
    """Return layers(maps), up to rounding.

    On a CPU the frames are computed in chunks, with the channels last in memory, and a transposed convolution of a
    single pixel is the matrix product that it equals. `benchmarks/README.md` has the gain of each. Elsewhere, and for
    fewer than 16 frames, this is layers(maps).

    Args:
        layers: convolutions or transposed convolutions, with activations.
        maps: `(N, C, H, W)`.
        pixels: pixels of the image that the layers read or write.
    """
    if maps.device.type != "cpu" or len(maps) < _FEW:
        whole: Tensor = layers(maps)
        return whole
    chunks = maps.split(max(1, _PIXELS // pixels))
    return torch.cat([_channels_last(layers, chunk) for chunk in chunks])  # (N, C', H', W')


def _channels_last(layers: nn.Sequential, maps: Tensor) -> Tensor:
    rest = [*layers]
    if isinstance(rest[0], nn.ConvTranspose2d) and maps.shape[-2:] == (1, 1):
        maps = _enlarge_pixel(rest.pop(0), maps)
    maps = maps.contiguous(memory_format=torch.channels_last)
    for layer in rest:
        maps = layer(maps)
    return maps


def _enlarge_pixel(layer: nn.ConvTranspose2d, pixel: Tensor) -> Tensor:
    """Return layer(pixel) for maps of one pixel: `(N, C, 1, 1)` to `(N, C', K, K)`."""
    product = pixel.flatten(1) @ layer.weight.flatten(1)  # (N, C' K K)
    kernels: Tensor = product.unflatten(1, layer.weight.shape[1:])  # (N, C', K, K)
    return kernels + cast(Tensor, layer.bias).view(-1, 1, 1)  # frozen, it is a tensor and no parameter
