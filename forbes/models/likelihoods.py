"""Observation likelihoods p(o_t | features): what a decoder's output means. Fully normalised, in nats."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.distributions import Categorical
from torch.nn.functional import log_softmax, one_hot, pad, softplus

from forbes.errors import ForbesError, require_positive
from forbes.performance.fusion import fused
from forbes.shapes import Observed
from forbes.symlog import symexp, symlog

__all__ = ["Bernoulli", "Likelihood", "Normal", "OneHot", "OnePixel", "SymlogNormal", "VectorNormal"]
__all__ += ["sum_of_parts"]


class Likelihood(ABC):
    """A density of the observation given the decoder's output. Its name is part of the name of every metric."""

    name: str
    rank: int
    """Dimensions of an observation: 3 of an image `(C, H, W)`, 1 of a vector `(O,)`."""

    def check(self, observation: Observed) -> None:  # noqa: B027  # most likelihoods take any value
        """Raise a ForbesError where stored observations `(*, *O)`, without padding, are outside the support."""

    @abstractmethod
    def target(self, observation: Observed) -> Tensor:
        """Turn a stored observation into the values the encoder reads and the density is about, float32."""

    @abstractmethod
    def mean(self, output: Tensor) -> Tensor:
        """Return E[o | output], for pictures as a grey value in [0, 1]; shape of `output`."""

    def picture(self, observation: Observed) -> Tensor:
        """Return a stored observation in the units of `mean`."""
        return self.target(observation)

    def images(self, values: Tensor) -> Tensor:
        """Return means or pictures as images to draw, `(*, C, H, W)`: here, the values themselves."""
        return values

    @abstractmethod
    def sample(self, output: Tensor) -> Tensor:
        """Draw an observation as `target` would give it; shape of `output`."""

    @abstractmethod
    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """Return log p(target | output) in nats: whole images `(*, C, H, W)`, or vectors `(*, O)`, to `(*)`."""

    def log_prob_by_part(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Return log p of each part of an observation in nats, `(*)`; nothing where it is one array."""
        return {}


def sum_of_parts(parts: Mapping[str, Tensor]) -> Tensor:
    """Return the log-likelihood of an observation from those of its parts, at least one."""
    first, *others = parts.values()
    return sum(others, first)


def _require_binary(name: str, observation: Tensor) -> None:
    least, most = observation.min().item(), observation.max().item()
    if not 0 <= least <= most <= 1:
        raise ForbesError(
            f"{name}: observations have values from {least:g} to {most:g}, expected 0 and 1. Use Normal as "
            "model.likelihood"
        )


class Bernoulli(Likelihood):
    r"""Binary pixels with the output u as logit: :math:`\log p(x) = \sum x u - \mathrm{softplus}(u)`.

    Example:
        >>> likelihood = forbes.Bernoulli()
        >>> target = likelihood.target(torch.ones(5, 1, 28, 28, dtype=torch.uint8))
        >>> likelihood.log_prob(torch.zeros(5, 1, 28, 28), target).shape
        torch.Size([5])
    """

    name, rank = "bernoulli", 3

    def check(self, observation: Tensor) -> None:
        """See `Likelihood.check`: values 0 and 1."""
        _require_binary(type(self).__name__, observation)

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: 0/1 as they are."""
        return observation.float()

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`."""
        return output.sigmoid()

    def sample(self, output: Tensor) -> Tensor:
        """See `Likelihood.sample`."""
        return output.sigmoid().bernoulli()

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        return (output * target - softplus(output)).sum((-3, -2, -1))


class OnePixel(Likelihood):
    r"""The one pixel i that is on, or none: the output u has a logit for each pixel, that of none is 0.

    .. math:: \log p(i) = u_i - \log\left(1 + \sum_j e^{u_j}\right), \qquad
              \log p(\text{none}) = -\log\left(1 + \sum_j e^{u_j}\right)

    A softmax does not change when all logits move together, so a fixed one loses nothing. Shapes are those of images,
    `(C, H, W)`, of which i counts all C H W values.

    Example:
        >>> likelihood = forbes.OnePixel()
        >>> target = likelihood.target(torch.zeros(5, 1, 28, 28, dtype=torch.uint8))
        >>> likelihood.log_prob(torch.zeros(5, 1, 28, 28), target).shape
        torch.Size([5])
    """

    name, rank = "categorical", 3

    def check(self, observation: Tensor) -> None:
        """See `Likelihood.check`: values 0 and 1, no more than one 1 in a frame."""
        _require_binary(type(self).__name__, observation)
        most = int(observation.flatten(-3).sum(-1, dtype=torch.long).max())
        if most > 1:
            raise ForbesError(
                f"OnePixel: a frame has {most} pixels that are on, expected at most 1. Use Bernoulli as "
                "model.likelihood; of strokes, frames: written with points_per_step: 1 have one"
            )

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: 0/1 as they are."""
        return observation.float()

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`: the probability of each pixel."""
        return (output - self._log_sum(output)[..., None, None, None]).exp()

    def sample(self, output: Tensor) -> Tensor:
        """See `Likelihood.sample`."""
        logits = pad(output.flatten(-3), (0, 1))  # (*, C H W + 1)
        pixel = Categorical(logits=logits).sample()  # (*)
        drawn = one_hot(pixel, logits.shape[-1])[..., :-1]  # (*, C H W)
        return drawn.to(output.dtype).view(output.shape)  # (*, C, H, W)

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        return (output * target).sum((-3, -2, -1)) - self._log_sum(output)

    @staticmethod
    def _log_sum(output: Tensor) -> Tensor:
        """Return log(1 + Σ exp u): `(*, C, H, W)` to `(*)`."""
        return softplus(output.logsumexp((-3, -2, -1)))


class _FixedStd(Likelihood):
    """Independent normal numbers of one fixed standard deviation around the output."""

    std: float

    def sample(self, output: Tensor) -> Tensor:
        """See `Likelihood.sample`."""
        return output + self.std * torch.randn_like(output)

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        return _normal(output, target, self.std, tuple(range(-self.rank, 0)))


class Normal(_FixedStd):
    r"""Pixels of fixed spread: :math:`N(x/scale - 1/2;\, output,\, \sigma^2)`, constant kept.

    With b < 8 bits, bytes are made coarser and the steps between them filled with noise, new for every reading, as in
    PlaNet (Hafner et al., 2019, arXiv 1811.04551): the density is about

    .. math:: (\lfloor x / 2^{8-b} \rfloor + u) / 2^b - 1/2, \qquad u \sim U[0, 1)

    Args:
        std: :math:`\sigma`; 1 in PlaNet, Dreamer and the paper.
        scale: the largest stored value, 255 for images and 1 for binary frames.
        bits: b; 5 in PlaNet and the paper, all 8 in Dreamer.

    Raises:
        ForbesError: when `std` or `scale` is not above 0, or `bits` not of 1 to 8, or below 8 for another scale than
            255.

    Example:
        >>> likelihood = forbes.Normal(std=0.5)
        >>> target = likelihood.target(torch.zeros(5, 3, 64, 64, dtype=torch.uint8))
        >>> likelihood.log_prob(torch.zeros(5, 3, 64, 64), target).shape
        torch.Size([5])
    """

    rank = 3

    def __init__(self, std: float = 1.0, scale: float = 255.0, bits: int = 8) -> None:
        if not 1 <= bits <= 8 or (bits < 8 and scale != 255):
            raise ForbesError(f"Normal: bits is {bits} at scale {scale:g}, expected 1 to 8 of bytes, scale 255")
        require_positive("Normal", std=std, scale=scale)
        self.std, self.scale, self.bits = std, scale, bits
        own = [f"scale={scale:g}"] * (scale != 255) + [f"bits={bits}"] * (bits != 8)
        self.name = f"normal({','.join([f'{std:g}', *own])})"

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: values in [-1/2, 1/2]."""
        if self.bits == 8:
            return observation.float() / self.scale - 0.5
        levels = 1 << self.bits
        coarse = (observation.float() * (levels / 256)).floor()
        return (coarse + torch.rand_like(coarse)) / levels - 0.5

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`."""
        return (output + 0.5).clamp(0, 1)

    def picture(self, observation: Tensor) -> Tensor:
        """See `Likelihood.picture`."""
        return observation.float() / self.scale


class VectorNormal(_FixedStd):
    r"""Vectors of numbers, each of fixed spread: :math:`N(x;\, output,\, \sigma^2)`.

    Args:
        std: :math:`\sigma`; the sensor's, where it is known.

    Raises:
        ForbesError: when `std` is not above 0.

    Example:
        >>> likelihood = forbes.VectorNormal(std=0.1)
        >>> target = likelihood.target(torch.ones(5, 3))
        >>> likelihood.log_prob(torch.zeros(5, 3), target).shape
        torch.Size([5])
    """

    rank = 1

    def __init__(self, std: float = 1.0) -> None:
        require_positive("VectorNormal", std=std)
        self.std = std
        self.name = f"normal({std:g})"

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: as they are."""
        return observation.float()

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`."""
        return output


class SymlogNormal(_FixedStd):
    r"""Vectors of numbers of unknown scale: the symlog of each is normal (DreamerV3, arXiv 2301.04104).

    .. math:: \log p(x) = \sum_i \log N(\mathrm{symlog}\,x_i;\, u_i,\, \sigma^2) - \log(1 + |x_i|), \qquad
              \mathrm{symlog}\,x = \mathrm{sign}(x) \log(1 + |x|)

    The last term is the derivative of symlog. DreamerV3 leaves it out. It has no gradient, and makes this a density of
    x, which can be compared with a `VectorNormal`. Encoder and decoder work on symlog x.

    Args:
        std: :math:`\sigma`; 1 in DreamerV3.

    Raises:
        ForbesError: when `std` is not above 0.

    Example:
        >>> likelihood = forbes.SymlogNormal()
        >>> target = likelihood.target(torch.ones(5, 3))
        >>> likelihood.log_prob(torch.zeros(5, 3), target).shape
        torch.Size([5])
    """

    rank = 1

    def __init__(self, std: float = 1.0) -> None:
        require_positive("SymlogNormal", std=std)
        self.std = std
        self.name = f"symlog-normal({std:g})"

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: their symlog."""
        return symlog(observation.float())

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`; here the median, which a monotone function keeps, in the observation's units."""
        return symexp(output)

    def picture(self, observation: Tensor) -> Tensor:
        """See `Likelihood.picture`."""
        return observation.float()

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`; the derivative of symlog at x is exp(-abs(symlog x))."""
        return super().log_prob(output, target) - target.abs().sum(-1)


class OneHot(Likelihood):
    r"""One of O symbols as a one-hot vector, with the output u as logits: :math:`\log p(x) = \log softmax(u)_x`.

    Example:
        >>> likelihood = forbes.OneHot()
        >>> target = likelihood.target(torch.eye(2)[torch.zeros(5, dtype=torch.long)])
        >>> likelihood.log_prob(torch.zeros(5, 2), target).shape
        torch.Size([5])
    """

    name, rank = "categorical", 1

    def check(self, observation: Tensor) -> None:
        """See `Likelihood.check`: one 1, and 0 elsewhere."""
        if not (((observation == 0) | (observation == 1)).all() and (observation.sum(-1) == 1).all()):
            raise ForbesError(
                "OneHot: observations are not one-hot, expected one 1 and 0 elsewhere. Use VectorNormal as "
                "model.likelihood"
            )

    def target(self, observation: Tensor) -> Tensor:
        """See `Likelihood.target`: as they are."""
        return observation.float()

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`: the probabilities."""
        return output.softmax(-1)

    def sample(self, output: Tensor) -> Tensor:
        """See `Likelihood.sample`."""
        symbol = Categorical(logits=output).sample()  # (*)
        return one_hot(symbol, output.shape[-1]).to(output.dtype)  # (*, O)

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        return (target * log_softmax(output, -1)).sum(-1)


@fused
def _normal(mean: Tensor, value: Tensor, std: float, dims: tuple[int, ...]) -> Tensor:
    """Return log N(value; mean, std²) in nats, summed over the last dimensions."""
    constant = math.log(std) + 0.5 * math.log(2 * math.pi)
    error = ((value - mean) / std).square().sum(dims)
    return -0.5 * error - constant * math.prod(value.shape[-len(dims) :])
