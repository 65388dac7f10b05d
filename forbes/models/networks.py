"""Networks of the world model: MLPs, image encoders and decoders (paper, appendix: Dreamer's)."""

import math
from collections.abc import Callable, Mapping
from itertools import chain, pairwise
from typing import Literal, TypeAlias, cast

from torch import Tensor, nn
from torch.nn.functional import elu, layer_norm, relu, silu

from forbes.configured import Configurable
from forbes.errors import ForbesError, require_at_least
from forbes.performance.convolutions import convolve
from forbes.performance.fusion import Elementwise, fused
from forbes.performance.recurrence import Layer, prepare_mlp
from forbes.performance.time_loop import TimeLoop
from forbes.shapes import Shape

__all__ = [
    "MLP",
    "ConvDecoder",
    "ConvEncoder",
    "Decoder",
    "Encoder",
    "MLPDecoder",
    "MLPEncoder",
    "NormSiLU",
    "activate",
    "one_array",
    "transposed_kernels",
]

Activation: TypeAlias = Literal["relu", "elu", "silu", "norm_silu"]
_KERNEL = 4
"""Side of the encoder's kernels in pixels."""
_NORM_EPS = 1e-3
"""DreamerV3's."""


@fused
def norm_silu(y: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return the SiLU of the layer norm of each row, `(*, W)`."""
    return silu(layer_norm(y, weight.shape, weight, bias, _NORM_EPS))


class NormSiLU(nn.LayerNorm):
    r"""A layer norm and a SiLU, what follows a linear layer in DreamerV3 (arXiv 2301.04104).

    .. math:: \mathrm{silu}\left(\gamma \odot \frac{y - \bar y}{\sqrt{\mathrm{var}(y) + \epsilon}} + \beta\right),
              \qquad \mathrm{silu}(x) = x\,\sigma(x)

    Args:
        width: dimensions of y.
    """

    def __init__(self, width: int) -> None:
        super().__init__(width, eps=_NORM_EPS)

    def forward(self, y: Tensor) -> Tensor:
        """Return the activation of rows, `(*, W)`."""
        return norm_silu(y, self.weight, self.bias)


_ACTIVATIONS: dict[Activation, Callable[[int], nn.Module]] = {
    "relu": lambda width: nn.ReLU(),
    "elu": lambda width: nn.ELU(),
    "silu": lambda width: nn.SiLU(),
    "norm_silu": NormSiLU,
}
_FUNCTIONS: dict[type[nn.Module], Elementwise] = {nn.ReLU: relu, nn.ELU: elu, nn.SiLU: silu, NormSiLU: norm_silu}


class MLP(nn.Sequential):
    """`layers` linear layers of `width`, each followed by an activation: ReLU, unless `activate` replaces it."""

    def __init__(self, input_dim: int, width: int, layers: int) -> None:
        dims = [input_dim] + [width] * layers
        super().__init__(*(nn.Sequential(nn.Linear(a, b), nn.ReLU()) for a, b in pairwise(dims)))

    def prepare(self, known: Tensor, loop: TimeLoop) -> Callable[[Tensor], Tensor]:
        """Return the network of [x, known] as a function of x, for the steps of a loop (see `prepare_mlp`)."""
        layers = [_layer(*block.children()) for block in self.children()]
        return prepare_mlp(layers, known, loop)


def _layer(linear: nn.Module, activation: nn.Module) -> Layer:
    """Return a linear layer and its activation for a time loop."""
    weight, bias = (cast(Tensor, getattr(linear, name)) for name in ("weight", "bias"))  # frozen ones are tensors
    return Layer(weight, bias, _FUNCTIONS[type(activation)], tuple(activation.parameters()))


def activate(module: nn.Module, activation: Activation) -> None:
    """Replace the activation of every MLP of a module."""
    for part in module.modules():
        if isinstance(part, MLP):
            for block in part.children():
                width = len(block.get_submodule("0").get_parameter("bias"))
                block.add_module("1", _ACTIVATIONS[activation](width))


class Encoder(Configurable, nn.Module):
    """e_t = encoder(o_t): images `(N, C, H, W)`, or vectors `(N, O)`, to embeddings `(N, E)`.

    Attributes:
        embedding_dim: E.
    """

    embedding_dim: int


class Decoder(Configurable, nn.Module):
    """Features `(N, F)` to the likelihood's parameters, in the observation's shape."""


EncoderFamily: TypeAlias = Callable[[Shape], Encoder]
"""Builds an encoder from the observation's shape."""
DecoderFamily: TypeAlias = Callable[[int, Shape], Decoder]
"""Builds a decoder from (feature_dim, observation_shape)."""


class MLPEncoder(Encoder):
    """MLP on vectors or flattened pixels: by far the cheapest encoder of small frames on a CPU.

    Args:
        observation_shape: (C, H, W), or (O,).
        width: width of each layer, and E.
        layers: number of layers.

    Example:
        >>> encoder = forbes.MLPEncoder((3,), width=16)
        >>> encoder(torch.zeros(7, 3)).shape
        torch.Size([7, 16])
    """

    def __init__(self, observation_shape: Shape, width: int = 200, layers: int = 2) -> None:
        super().__init__()
        require_at_least(1, "MLPEncoder", width=width, layers=layers)
        self.embedding_dim = width
        self.net = MLP(math.prod(one_array(observation_shape, "MLPEncoder")), width, layers)

    def forward(self, observation: Tensor) -> Tensor:
        """See `Encoder`."""
        embedding: Tensor = self.net(observation.flatten(1))  # (N, E)
        return embedding


class MLPDecoder(Decoder):
    """MLP to vectors or pixels.

    Args:
        feature_dim: F.
        observation_shape: (C, H, W), or (O,).
        width: width of each hidden layer.
        layers: number of hidden layers.
        output_bias: initial output. The mean pixel, for strokes a logit of -4 or a value of -0.48, saves
            the first thousand updates of learning that most pixels are off, in which a posterior can collapse.

    Example:
        >>> decoder = forbes.MLPDecoder(feature_dim=30, observation_shape=(3,), width=16)
        >>> decoder(torch.zeros(7, 30)).shape
        torch.Size([7, 3])
    """

    def __init__(
        self,
        feature_dim: int,
        observation_shape: Shape,
        width: int = 200,
        layers: int = 2,
        output_bias: float = 0.0,
    ) -> None:
        super().__init__()
        require_at_least(1, "MLPDecoder", width=width, layers=layers)
        self.observation_shape = one_array(observation_shape, "MLPDecoder")
        last = nn.Linear(width, math.prod(self.observation_shape))
        if output_bias:
            nn.init.constant_(last.bias, output_bias)
        self.net = nn.Sequential(MLP(feature_dim, width, layers), last)

    def forward(self, features: Tensor) -> Tensor:
        """See `Decoder`."""
        output: Tensor = self.net(features)
        return output.view(-1, *self.observation_shape)  # (N, *O)


def one_array(observation_shape: Shape, name: str) -> tuple[int, ...]:
    """Return the shape of observations that are one array; refuse those of several parts, for a network's name."""
    if isinstance(observation_shape, Mapping):
        role = "encoder" if name.endswith("Encoder") else "decoder"
        raise ForbesError(
            f"{name}: found observations of the parts {', '.join(observation_shape)}, expected one array. Use "
            f"Parts{role.capitalize()} as model.{role}, with one {role} for each part"
        )
    return observation_shape


def _convolutions(observation_shape: tuple[int, ...], role: str) -> tuple[int, list[int]]:
    """Return how many convolutions of kernel 4 and stride 2 fit into an image `(C, H, W)`, and the H and W they leave.

    They end where the shorter side has fewer than 4 pixels.

    Raises:
        ForbesError: for vectors, or images with a side below 4 pixels.
    """
    if len(observation_shape) != 3 or min(observation_shape[1:]) < _KERNEL:
        raise ForbesError(
            f"Conv{role}: found observations of shape {(*observation_shape,)}, expected images (C, H, W) of at least "
            f"{_KERNEL} pixels a side. Use MLP{role} as model.{role.lower()}"
        )
    layers, sides = 0, list(observation_shape[1:])
    while min(sides) >= _KERNEL:
        layers, sides = layers + 1, [(side - _KERNEL) // 2 + 1 for side in sides]
    return layers, sides


class ConvEncoder(Encoder):
    """Dreamer's encoder: convolutions of kernel 4 and stride 2 until the shorter side has fewer than 4 pixels.

    64 pixels: 64-31-14-6-2, E = 1024 at 32 channels. 28 pixels: 28-13-5-1, E = 128. A kernel that does not fit at the
    right or the lower edge is left out, as in Dreamer: of 64 pixels a side the last 2 are not seen, of 28 the last 6.

    Args:
        observation_shape: (C, H, W), at least 4 pixels a side.
        channels: channels of the first layer; each further layer has twice as many.

    Raises:
        ForbesError: for vectors, or smaller images.

    Example:
        >>> encoder = forbes.ConvEncoder((3, 64, 64))
        >>> encoder(torch.zeros(7, 3, 64, 64)).shape
        torch.Size([7, 1024])
    """

    def __init__(self, observation_shape: Shape, channels: int = 32) -> None:
        super().__init__()
        require_at_least(1, "ConvEncoder", channels=channels)
        shape = one_array(observation_shape, "ConvEncoder")
        layers, sides = _convolutions(shape, "Encoder")
        widths = [shape[0], *(channels * 2**layer for layer in range(layers))]
        blocks = [(nn.Conv2d(before, after, _KERNEL, stride=2), nn.ReLU()) for before, after in pairwise(widths)]
        self.net = nn.Sequential(*chain(*blocks))
        self.embedding_dim = widths[-1] * math.prod(sides)
        self.pixels = math.prod(shape[1:])

    def forward(self, observation: Tensor) -> Tensor:
        """See `Encoder`."""
        return convolve(self.net, observation, self.pixels).flatten(1)  # (N, E)


class ConvDecoder(Decoder):
    r"""Dreamer's decoder: a linear layer, then as many transposed convolutions of stride 2 as the encoder has layers.

    The linear layer makes a map with one pixel a side fewer than the encoder ends with, at least one. Its channels are
    `channels` times half the shorter side, rounded down to a power of two: 32 times for 64 pixels, 8 times for 28.

    64 pixels: kernels 5, 5, 6, 6 (1-5-13-30-64), 3,795,555 parameters with 230 features and 3 channels. 28 pixels:
    kernels 5, 5, 4 (1-5-13-28). Sides of different length have kernels of their own (`transposed_kernels`).

    Args:
        feature_dim: F.
        observation_shape: (C, H, W), at least 4 pixels a side.
        channels: channels of the last hidden layer; each layer before has twice as many.
        output_bias: initial output, see `MLPDecoder`.

    Raises:
        ForbesError: for vectors, or smaller images.

    Example:
        >>> decoder = forbes.ConvDecoder(feature_dim=30, observation_shape=(3, 64, 64))
        >>> decoder(torch.zeros(7, 30)).shape
        torch.Size([7, 3, 64, 64])
    """

    def __init__(
        self, feature_dim: int, observation_shape: Shape, channels: int = 32, output_bias: float = 0.0
    ) -> None:
        super().__init__()
        require_at_least(1, "ConvDecoder", channels=channels)
        shape = one_array(observation_shape, "ConvDecoder")
        layers, encoded = _convolutions(shape, "Decoder")
        depth, *sides = shape
        first = [max(side - 1, 1) for side in encoded]
        self.start_shape = channels * 2 ** (min(sides).bit_length() - 2), *first  # (C_0, H_0, W_0)
        self.start = nn.Linear(feature_dim, math.prod(self.start_shape))
        kernels = zip(*(transposed_kernels(*ends, layers) for ends in zip(first, sides, strict=True)), strict=True)
        widths = [self.start_shape[0], *(channels * 2**layer for layer in reversed(range(layers - 1))), depth]
        convolutions = [
            nn.ConvTranspose2d(before, after, kernel, stride=2)
            for (before, after), kernel in zip(pairwise(widths), kernels, strict=True)
        ]
        if output_bias:
            nn.init.constant_(convolutions[-1].get_parameter("bias"), output_bias)
        blocks = [block for convolution in convolutions for block in (convolution, nn.ReLU())]
        self.net = nn.Sequential(*blocks[:-1])
        self.pixels = math.prod(sides)

    def forward(self, features: Tensor) -> Tensor:
        """See `Decoder`."""
        start = self.start(features).unflatten(-1, self.start_shape)  # (N, C_0, H_0, W_0)
        return convolve(self.net, start, self.pixels)  # (N, C, H, W)


def transposed_kernels(first: int, last: int, layers: int) -> list[int]:
    r"""Return the kernels by which transposed convolutions of stride 2 enlarge a side from `first` to `last` pixels.

    .. math:: n_l = 2 (n_{l-1} - 1) + k_l \quad\Rightarrow\quad
              n_L - 2^L n_0 = \sum_{l=1}^{L} 2^{L-l} (k_l - 2)

    All are equal, or some larger by one: those where the binary digits of the remainder of
    :math:`(n_L - 2^L n_0) / (2^L - 1)` are 1. From 1 to 64 in four layers: 48 = 3 · 15 + 3, so 5, 5, 6, 6, which is
    Dreamer's choice.
    """
    base, rest = divmod(last - 2**layers * first, 2**layers - 1)
    return [2 + base + (rest >> layer & 1) for layer in reversed(range(layers))]
