"""Networks of the world model: perceptrons, image encoders and decoders (paper, appendix: Dreamer's)."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar, Literal, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.functional import elu, relu

from forbes.deferred import Loop
from forbes.errors import ForbesError
from forbes.fusion import Elementwise, fused

__all__ = [
    "ConvDecoder",
    "ConvEncoder",
    "Decoder",
    "Encoder",
    "MLPDecoder",
    "MLPEncoder",
    "Perceptron",
    "activate",
    "bind_gru",
]

Activation: TypeAlias = Literal["relu", "elu"]
_ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "elu": nn.ELU}
_FUNCTIONS: dict[type[nn.Module], Elementwise] = {nn.ReLU: relu, nn.ELU: elu}


class Perceptron(nn.Sequential):
    """`layers` linear layers of `width`, each followed by the activation: a ReLU, until `activate` says otherwise."""

    def __init__(self, input_dim: int, width: int, layers: int) -> None:
        dims = [input_dim] + [width] * layers
        super().__init__(*(nn.Sequential(nn.Linear(a, b), nn.ReLU()) for a, b in pairwise(dims)))

    @property
    def linear(self) -> list[nn.Linear]:
        """The linear layers alone."""
        return [layer for layer in self.modules() if isinstance(layer, nn.Linear)]

    @property
    def activation(self) -> Elementwise:
        """What follows each of them."""
        return _FUNCTIONS[type(self.get_submodule("0.1"))]


def activate(module: nn.Module, activation: Activation) -> None:
    """Give every perceptron of a module another activation."""
    for part in module.modules():
        if isinstance(part, Perceptron):
            for block in part.children():
                block.add_module("1", _ACTIVATIONS[activation]())


def bind_gru(cell: nn.GRUCell, loop: Loop) -> Callable[[Tensor, Tensor], Tensor]:
    r"""Bind a GRU cell to a loop: (x, h) to the next h, `(B, H)`; the same numbers as `cell(x, h)`.

    .. math:: r, z = \sigma(W_{ir} x + W_{hr} h), \sigma(W_{iz} x + W_{hz} h), \quad
              n = \tanh(W_{in} x + r \odot W_{hn} h), \quad h' = n + z \odot (h - n)
    """
    of_input = loop.affine(cell.weight_ih, cell.bias_ih)
    of_hidden = loop.affine(cell.weight_hh, cell.bias_hh, _gate)
    return lambda x, hidden: of_hidden(hidden, of_input(x), hidden)


@fused
def _gate(of_hidden: Tensor, of_x: Tensor, hidden: Tensor) -> Tensor:
    """Give the next h of a GRU, `(B, H)`, from the shares of h and x, `(B, 3 H)`."""
    sizes = [2 * hidden.shape[-1], hidden.shape[-1]]
    gates_x, new_x = of_x.split(sizes, -1)  # (B, 2 H), (B, H)
    gates_h, new_h = of_hidden.split(sizes, -1)  # (B, 2 H), (B, H)
    reset, update = (gates_x + gates_h).sigmoid().chunk(2, -1)  # 2 x (B, H)
    return torch.lerp(torch.addcmul(new_x, reset, new_h).tanh(), hidden, update)


class Encoder(nn.Module):
    """e_t = encoder(o_t): images `(N, C, H, W)`, or vectors `(N, O)`, to embeddings `(N, E)`.

    Attributes:
        embedding_dim: E.
    """

    embedding_dim: int


class Decoder(nn.Module):
    """Features `(N, F)` to the likelihood's parameters, in the observation's shape."""


EncoderFamily: TypeAlias = Callable[[tuple[int, ...]], Encoder]
"""Builds an encoder from the observation's shape."""
DecoderFamily: TypeAlias = Callable[[int, tuple[int, ...]], Decoder]
"""Builds a decoder from (feature_dim, observation_shape)."""


class MLPEncoder(Encoder):
    """Perceptron on vectors or flattened pixels: by far the cheapest encoder of small frames on a CPU.

    Args:
        observation_shape: (C, H, W), or (O,).
        width: width of each layer, and E.
        layers: how many.
    """

    def __init__(self, observation_shape: tuple[int, ...], width: int = 200, layers: int = 2) -> None:
        super().__init__()
        self.embedding_dim = width
        self.net = Perceptron(math.prod(observation_shape), width, layers)

    def forward(self, observation: Tensor) -> Tensor:
        """See `Encoder`."""
        embedding: Tensor = self.net(observation.flatten(1))  # (N, E)
        return embedding


class MLPDecoder(Decoder):
    """Perceptron to vectors or pixels.

    Args:
        feature_dim: F.
        observation_shape: (C, H, W), or (O,).
        width: width of each hidden layer.
        layers: how many hidden layers.
        output_bias: the output it starts from. The mean pixel, for strokes a logit of -4 or a value of -0.48, saves
            the first thousand updates of learning that most pixels are off, in which a posterior can collapse.
    """

    def __init__(
        self,
        feature_dim: int,
        observation_shape: tuple[int, ...],
        width: int = 200,
        layers: int = 2,
        output_bias: float = 0.0,
    ) -> None:
        super().__init__()
        self.observation_shape = observation_shape
        last = nn.Linear(width, math.prod(observation_shape))
        if output_bias:
            nn.init.constant_(last.bias, output_bias)
        self.net = nn.Sequential(Perceptron(feature_dim, width, layers), last)

    def forward(self, features: Tensor) -> Tensor:
        """See `Decoder`."""
        output: Tensor = self.net(features)
        return output.view(-1, *self.observation_shape)  # (N, *O)


def _image_size(observation_shape: tuple[int, ...], role: str) -> tuple[int, int]:
    """Give channels and pixels a side, or raise a ForbesError where observations are no images."""
    if len(observation_shape) != 3:
        raise ForbesError(
            f"Conv{role}: found observations of shape {(*observation_shape,)}, expected images (C, H, W). "
            f"Use MLP{role} as model.{role.lower()}"
        )
    return observation_shape[:2]


class ConvEncoder(Encoder):
    """Dreamer's encoder: convolutions of kernel 4 and stride 2 until fewer than 4 pixels are left.

    64 pixels: 64-31-14-6-2, E = 1024 at 32 channels. 28 pixels: 28-13-5-1, E = 128.

    Args:
        observation_shape: (C, H, W).
        channels: of the first layer; each further layer has twice as many.

    Raises:
        ForbesError: for vectors.
    """

    def __init__(self, observation_shape: tuple[int, ...], channels: int = 32) -> None:
        super().__init__()
        depth, size = _image_size(observation_shape, "Encoder")
        blocks: list[nn.Module] = []
        while size >= 4:
            blocks += [nn.Conv2d(depth, channels, 4, stride=2), nn.ReLU()]
            depth, channels, size = channels, 2 * channels, (size - 4) // 2 + 1
        self.net = nn.Sequential(*blocks)
        self.embedding_dim = depth * size * size

    def forward(self, observation: Tensor) -> Tensor:
        """See `Encoder`."""
        maps: Tensor = self.net(observation)
        return maps.flatten(1)  # (N, E)


class ConvDecoder(Decoder):
    """Dreamer's decoder: a linear layer, then transposed convolutions of stride 2 from one pixel up.

    64 pixels: kernels 5, 5, 6, 6 (1-5-13-30-64). 28 pixels: kernels 5, 5, 4 (1-5-13-28).

    Args:
        feature_dim: F.
        observation_shape: (C, H, W), H = W = 64 or 28.
        channels: of the last hidden layer; each layer before has twice as many.
        output_bias: the output it starts from, see `MLPDecoder`.

    Raises:
        ForbesError: for another size, or vectors.
    """

    kernels: ClassVar = {64: (5, 5, 6, 6), 28: (5, 5, 4)}

    def __init__(
        self, feature_dim: int, observation_shape: tuple[int, ...], channels: int = 32, output_bias: float = 0.0
    ) -> None:
        super().__init__()
        depth, size = _image_size(observation_shape, "Decoder")
        if size not in self.kernels:
            raise ForbesError(f"ConvDecoder: observations have {size} pixels, expected 28 or 64. Use MLPDecoder")
        kernels = self.kernels[size]
        widths = [channels * 2 ** (len(kernels) - k - 1) for k in range(1, len(kernels))] + [depth]
        self.start_dim = channels * 2 ** len(kernels)
        self.start = nn.Linear(feature_dim, self.start_dim)
        layers = [
            nn.ConvTranspose2d(before, after, kernel, stride=2)
            for (before, after), kernel in zip(pairwise([self.start_dim, *widths]), kernels, strict=True)
        ]
        if output_bias:
            nn.init.constant_(layers[-1].get_parameter("bias"), output_bias)
        blocks = [block for layer in layers for block in (layer, nn.ReLU())]
        self.net = nn.Sequential(*blocks[:-1])

    def forward(self, features: Tensor) -> Tensor:
        """See `Decoder`."""
        output: Tensor = self.net(self.start(features).unflatten(-1, (self.start_dim, 1, 1)))  # (N, C, H, W)
        return output
