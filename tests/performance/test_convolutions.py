"""The fast convolutions are the layers that they compute: values, gradients, any size, any number of frames."""

import pytest
import torch
from torch import Tensor, nn

from forbes.models import ConvDecoder, ConvEncoder
from forbes.performance import convolutions
from forbes.performance.convolutions import convolve

SHAPES = [(3, 64, 64), (1, 28, 28), (2, 16, 28), (3, 16, 9)]
TOLERANCE = 1e-11  # of sums of a thousand products of order 1 in float64, and of their gradients


def gradients(output: Tensor, layers: nn.Module, inputs: Tensor, weights: Tensor) -> list[Tensor]:
    return [output, *torch.autograd.grad((output * weights).sum(), [inputs, *layers.parameters()])]


@pytest.fixture(params=SHAPES, ids=str)
def layers_and_maps(request, monkeypatch):
    """An encoder's or a decoder's convolutions in chunks of five frames, and 18 maps."""
    shape = request.param
    pixels = shape[1] * shape[2]
    monkeypatch.setattr(convolutions, "_PIXELS", 5 * pixels)
    torch.manual_seed(0)
    encoder, decoder = ConvEncoder(shape, channels=4).double(), ConvDecoder(5, shape, channels=4).double()
    return pixels, [
        (encoder.net, torch.randn(18, *shape, dtype=torch.float64)),
        (decoder.net, torch.randn(18, *decoder.start_shape, dtype=torch.float64)),
    ]


def test_values_and_gradients_are_those_of_the_layers(layers_and_maps):
    pixels, cases = layers_and_maps
    for layers, maps in cases:
        maps.requires_grad_()
        plain = layers(maps)
        weights = torch.randn_like(plain)
        ours = gradients(convolve(layers, maps, pixels), layers, maps, weights)
        for found, expected in zip(ours, gradients(plain, layers, maps, weights), strict=True):
            torch.testing.assert_close(found, expected, rtol=TOLERANCE, atol=TOLERANCE)


def test_images_of_more_pixels_than_a_chunk_are_taken_one_by_one(monkeypatch):
    monkeypatch.setattr(convolutions, "_PIXELS", 100)
    encoder = ConvEncoder((3, 28, 28), channels=4)
    seen = []
    encoder.net[0].register_forward_hook(lambda module, inputs, output: seen.append(len(output)))
    assert encoder(torch.zeros(16, 3, 28, 28)).shape == (16, 16)
    assert seen == 16 * [1]


def test_no_frames_give_no_embeddings():
    assert ConvEncoder((3, 28, 28), channels=4)(torch.zeros(0, 3, 28, 28)).shape == (0, 16)
    assert ConvDecoder(5, (3, 28, 28), channels=4)(torch.zeros(0, 5)).shape == (0, 3, 28, 28)


def test_many_single_pixels_are_enlarged_by_a_product():
    decoder = ConvDecoder(5, (3, 64, 64), channels=4)
    called = []
    decoder.net[0].register_forward_hook(lambda *_: called.append(True))
    decoder(torch.zeros(16, 5))
    assert not called
    decoder(torch.zeros(1, 5))
    assert called
