"""Encoders and decoders: the sizes their documentation gives, each image on its own."""

from functools import partial, reduce

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from forbes.errors import ForbesError
from forbes.models import ConvDecoder, ConvEncoder, MLPDecoder, MLPEncoder, PixelDecoder, PixelEncoder
from forbes.models.networks import MLP, activate, transposed_kernels


@pytest.mark.parametrize(
    ("shape", "embedding_dim"), [((3, 64, 64), 1024), ((1, 28, 28), 128), ((3, 64, 96), 2 * 4 * 256)]
)
def test_conv_encoder_gives_dreamers_embedding(shape, embedding_dim):
    encoder = ConvEncoder(shape)

    assert encoder.embedding_dim == embedding_dim
    assert encoder(torch.zeros(2, *shape)).shape == (2, embedding_dim)


def test_conv_decoder_is_dreamers_layer_by_layer():
    """danijar/dreamer: 1024 units, then 128 of 5, 64 of 5, 32 of 6 and 3 of 6."""
    decoder = ConvDecoder(230, (3, 64, 64))
    layers = [layer for layer in decoder.net if isinstance(layer, nn.ConvTranspose2d)]

    assert decoder.start.weight.shape == (1024, 230)
    assert [(layer.out_channels, *layer.kernel_size, *layer.stride) for layer in layers] == [
        (128, 5, 5, 2, 2),
        (64, 5, 5, 2, 2),
        (32, 6, 6, 2, 2),
        (3, 6, 6, 2, 2),
    ]


def test_conv_decoder_of_28_pixels_starts_with_256_units():
    decoder = ConvDecoder(22, (1, 28, 28))
    weights = [layer.weight.shape for layer in decoder.net if isinstance(layer, nn.ConvTranspose2d)]

    assert decoder.start.weight.shape == (256, 22)
    assert weights == [(256, 64, 5, 5), (64, 32, 5, 5), (32, 1, 4, 4)]


@pytest.mark.parametrize("sides", [(16, 16), (16, 50), (64, 96), (96, 64), (84, 84), (61, 62), (93, 31), (128, 128)])
@pytest.mark.parametrize("channels", [1, 4])
def test_convolutions_are_for_images_of_any_sides(channels, sides):
    shape = (channels, *sides)
    encoder, decoder = ConvEncoder(shape, channels=2), ConvDecoder(5, shape, channels=2)

    embedding, output = encoder(torch.zeros(2, *shape)), decoder(torch.zeros(2, 5))

    assert embedding.shape == (2, encoder.embedding_dim)
    assert output.shape == (2, *shape)


@settings(deadline=None, derandomize=True)
@given(first=st.integers(1, 30), layers=st.integers(1, 7), share=st.floats(0, 1))
def test_kernels_connect_the_sizes_and_differ_by_one_at_most(first, layers, share):
    """From the smallest size, by kernels of 2, to one of kernels of 30."""
    last = 2**layers * first + int(28 * share * (2**layers - 1))

    kernels = transposed_kernels(first, last, layers)

    assert len(kernels) == layers
    assert max(kernels) - min(kernels) <= 1
    assert reduce(lambda size, kernel: 2 * (size - 1) + kernel, kernels, first) == last


def test_encoder_and_decoder_kernels_have_4_to_7_pixels():
    """Wherever a side lies: a kernel below the stride of 2 would leave gaps, a wide one would cost much."""
    for side in range(4, 300):
        layers = [m for m in ConvDecoder(1, (1, side, 300), channels=1).net if isinstance(m, nn.ConvTranspose2d)]
        assert {size for layer in layers for size in layer.kernel_size} <= {4, 5, 6, 7}


def test_mlp_encoder_gives_its_width():
    encoder = MLPEncoder((1, 28, 28), width=40, layers=3)

    assert encoder.embedding_dim == 40
    assert encoder(torch.zeros(2, 1, 28, 28)).shape == (2, 40)


@pytest.mark.parametrize("family", [ConvDecoder, MLPDecoder])
@pytest.mark.parametrize("shape", [(3, 64, 64), (1, 28, 28)])
def test_decoders_give_images(family, shape):
    assert family(17, shape)(torch.zeros(2, 17)).shape == (2, *shape)


@pytest.mark.parametrize("family", [ConvDecoder, MLPDecoder])
def test_decoders_start_from_the_output_they_are_told(family):
    torch.manual_seed(0)
    features = torch.zeros(1, 17)

    for bias in (0.0, -4.0):
        output = family(17, (1, 28, 28), output_bias=bias)(features)
        assert output.mean().item() == pytest.approx(bias, abs=0.5)


@pytest.mark.parametrize(
    "network",
    [
        ConvEncoder((1, 28, 28), channels=4),
        MLPEncoder((1, 28, 28)),
        nn.Sequential(nn.Flatten(), nn.LazyLinear(9), ConvDecoder(9, (1, 28, 28), channels=4)),
        nn.Sequential(nn.Flatten(), nn.LazyLinear(9), MLPDecoder(9, (1, 28, 28))),
    ],
    ids=["ConvEncoder", "MLPEncoder", "ConvDecoder", "MLPDecoder"],
)
def test_an_image_is_treated_alone_as_in_a_batch(network):
    images = torch.randn(3, 1, 28, 28, generator=torch.Generator().manual_seed(0))

    torch.testing.assert_close(network(images[1:2]), network(images)[1:2])


@pytest.mark.parametrize(("activation", "lowest"), [("relu", 0), ("elu", -1)])
def test_perceptron_ends_with_its_activation(activation, lowest):
    network = MLP(3, width=5, layers=2)
    activate(network, activation)

    output = network(100 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0)))

    assert output.shape == (100, 5)
    assert output.min() == lowest


def test_a_normed_layer_does_not_feel_the_scale_of_its_input():
    """Exact but for epsilon, 1e-3 of the variance: here 1e-3 of at least 1e4."""
    network = MLP(3, width=50, layers=1)
    activate(network, "norm_silu")
    torch.nn.init.zeros_(network[0][0].bias)
    rows = 1e3 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0))

    torch.testing.assert_close(network(10 * rows), network(rows), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("network", "sizes"), [(ConvEncoder, ()), (ConvDecoder, (10,))])
@pytest.mark.parametrize("shape", [(5,), (3, 3, 64), (1, 64, 3)])
def test_convolutions_are_not_for_vectors_or_specks(network, sizes, shape):
    with pytest.raises(
        ForbesError, match=rf"{network.__name__}: found .* \({shape[0]},.*\), .* Use MLP.*coder as model\..*coder$"
    ):
        network(*sizes, shape)


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (partial(MLPEncoder, (3,)), "layers"),
        (partial(MLPEncoder, (3,)), "width"),
        (partial(MLPDecoder, 5, (3,)), "layers"),
        (partial(ConvEncoder, (1, 16, 16)), "channels"),
        (partial(ConvDecoder, 5, (1, 16, 16)), "channels"),
        (partial(PixelEncoder, (1, 8, 8)), "width"),
        (partial(PixelDecoder, 5, (1, 8, 8)), "width"),
    ],
)
def test_a_network_of_no_size_is_refused(make, argument):
    with pytest.raises(ForbesError, match=rf"^{make.func.__name__}: {argument} is 0, expected at least 1"):
        make(**{argument: 0})
