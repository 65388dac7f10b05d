r"""Networks for observations of at most one pixel: an embedding in place of a convolution, logits of places.

A pixel (i, j) is told apart by its own vector, and by those of its row and its column, which it shares with its
neighbours: what is learned of one pixel is half learned of those next to it.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, relu

from forbes.errors import ForbesError, require_at_least
from forbes.models.networks import Decoder, Encoder, one_array
from forbes.shapes import Shape

__all__ = ["PixelDecoder", "PixelEncoder"]


class PixelEncoder(Encoder):
    r"""Look up the pixel that is on.

    .. math:: e(o) = \mathrm{ReLU}(P_{ij} + R_i + C_j + b), \qquad e(\text{none}) = \mathrm{ReLU}(b)

    The same as a linear layer of the frame with its sums over rows and columns, at the cost of a look-up.

    Args:
        observation_shape: (1, H, W).
        width: E.

    Raises:
        ForbesError: for other shapes.

    Example:
        >>> encoder = forbes.PixelEncoder((1, 28, 28), width=16)
        >>> encoder(torch.zeros(7, 1, 28, 28)).shape
        torch.Size([7, 16])
    """

    def __init__(self, observation_shape: Shape, width: int = 256) -> None:
        super().__init__()
        require_at_least(1, "PixelEncoder", width=width)
        height, self.side = _sides(one_array(observation_shape, "PixelEncoder"), "Encoder")
        self.embedding_dim = width
        self.pixel = nn.Embedding(height * self.side, width)
        self.row, self.column = nn.Embedding(height, width), nn.Embedding(self.side, width)
        nn.init.normal_(self.pixel.weight, std=0.05)  # at first a pixel is mostly where it is
        for place in (self.row, self.column):
            nn.init.normal_(place.weight, std=0.5)
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, observation: Tensor) -> Tensor:
        """See `Encoder`; of frames with no more than one pixel."""
        on, index = observation.flatten(1).max(-1, keepdim=True)  # (N, 1), (N, 1)
        index = index[:, 0]  # (N,)
        place = self.pixel(index) + self.row(index // self.side) + self.column(index % self.side)  # (N, E)
        return relu(on * place + self.bias)


class PixelDecoder(Decoder):
    r"""A residual network to the logits of every pixel.

    .. math::

        x_0 = W f, \qquad x_k = x_{k-1} + B_k\,\mathrm{ReLU}(A_k\,\mathrm{LN}(x_{k-1})), \qquad
        y = \mathrm{ReLU}(\mathrm{LN}(x_K)) \\
        u_{ij} = (P_{ij} + R_i + C_j) \cdot y + p_{ij} + r_i + c_j

    Args:
        feature_dim: F.
        observation_shape: (1, H, W).
        width: of x.
        blocks: K.

    Raises:
        ForbesError: for other shapes.

    Example:
        >>> decoder = forbes.PixelDecoder(feature_dim=30, observation_shape=(1, 28, 28), width=16)
        >>> decoder(torch.zeros(7, 30)).shape
        torch.Size([7, 1, 28, 28])
    """

    def __init__(self, feature_dim: int, observation_shape: Shape, width: int = 256, blocks: int = 1) -> None:
        super().__init__()
        require_at_least(1, "PixelDecoder", width=width)
        require_at_least(0, "PixelDecoder", blocks=blocks)
        self.observation_shape = one_array(observation_shape, "PixelDecoder")
        height, side = _sides(self.observation_shape, "Decoder")
        self.first = nn.Linear(feature_dim, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))
            for _ in range(blocks)
        )
        self.norm = nn.LayerNorm(width)
        self.pixel, self.row, self.column = (nn.Linear(width, size) for size in (height * side, height, side))

    def forward(self, features: Tensor) -> Tensor:
        """See `Decoder`."""
        x = self.first(features)  # (N, W)
        for block in self.blocks:
            x = x + block(x)
        output = linear(relu(self.norm(x)), *self._places())  # (N, H W)
        return output.view(-1, *self.observation_shape)  # (N, 1, H, W)

    def _places(self) -> tuple[Tensor, Tensor]:
        """Return weight and bias of all pixels, `(H W, W)` and `(H W,)`."""
        weight = self.row.weight[:, None] + self.column.weight  # (H, W, width)
        bias = self.row.bias[:, None] + self.column.bias  # (H, W)
        return (
            self.pixel.weight + weight.flatten(0, 1),  # (H W, width)
            self.pixel.bias + bias.flatten(),  # (H W,)
        )


def _sides(observation_shape: tuple[int, ...], role: str) -> tuple[int, int]:
    """Return (H, W), or raise a ForbesError where observations are not images of one channel."""
    if len(observation_shape) != 3 or observation_shape[0] != 1:
        raise ForbesError(
            f"Pixel{role}: found observations of shape {(*observation_shape,)}, expected (1, H, W). Use MLP{role} or "
            f"Conv{role} as model.{role.lower()}"
        )
    return observation_shape[1:]
