"""Encoders and decoders: the sizes their documentation gives, each image on its own."""

import pytest
import torch
from torch import nn

from forbes.errors import ForbesError
from forbes.models import ConvDecoder, ConvEncoder, MLPDecoder, MLPEncoder
from forbes.models.networks import Perceptron, activate


@pytest.mark.parametrize(("shape", "embedding_dim"), [((3, 64, 64), 1024), ((1, 28, 28), 128)])
def test_conv_encoder_gives_dreamers_embedding(shape, embedding_dim):
    encoder = ConvEncoder(shape)

    assert encoder.embedding_dim == embedding_dim
    assert encoder(torch.zeros(2, *shape)).shape == (2, embedding_dim)


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


def test_conv_decoder_names_the_sizes_it_can_make():
    with pytest.raises(ForbesError, match="have 32 pixels, expected 28 or 64"):
        ConvDecoder(17, (1, 32, 32))


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
    network = Perceptron(3, width=5, layers=2)
    activate(network, activation)

    output = network(100 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0)))

    assert output.shape == (100, 5)
    assert output.min() == lowest


@pytest.mark.parametrize(("network", "sizes"), [(ConvEncoder, ()), (ConvDecoder, (10,))])
def test_convolutions_are_not_for_vectors(network, sizes):
    with pytest.raises(
        ForbesError, match=rf"{network.__name__}: found .* \(5,\), .* Use MLP.*coder as model\..*coder$"
    ):
        network(*sizes, (5,))
