r"""Observations of several parts, e.g. an image and a vector: a likelihood, an encoder and a decoder for each.

.. math:: e_t = [e^1_t, \dots, e^n_t], \quad e^i_t = \mathrm{encoder}_i(o^i_t), \qquad
          \log p(o_t \mid f_t) = \sum_i \log p_i(o^i_t \mid f_t)

A stored observation is a dict. `PartsLikelihood.target` makes one vector of it, in which the parts stand one after the
other, flat and in the order of their names. Nothing else in a model, a bound or a score knows of parts.
"""

from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from forbes.errors import ForbesError
from forbes.models.likelihoods import Likelihood, sum_of_parts
from forbes.models.networks import Decoder, DecoderFamily, Encoder, EncoderFamily
from forbes.shapes import Observed, Shape, size_of

__all__ = ["PartsDecoder", "PartsEncoder", "PartsLikelihood", "side_by_side"]


class PartsLikelihood(Likelihood):
    r"""The parts of an observation, independent given the features: :math:`\log p(o) = \sum_i \log p_i(o^i)`.

    Target, output, mean, sample and picture are flat, `(*, O)`; `split` gives the parts of each back. The shapes of the
    parts are set by `for_shape`, which a `WorldModel` calls.

    Args:
        parts: likelihood of each part by its name.

    Example:
        >>> parts = {"camera": forbes.Normal(), "proprio": forbes.VectorNormal(0.1)}
        >>> likelihood = forbes.PartsLikelihood(parts).for_shape({"camera": (3, 8, 8), "proprio": (4,)})
        >>> likelihood.name
        'camera=normal(1),proprio=normal(0.1)'
        >>> observation = {"camera": torch.zeros(5, 3, 8, 8, dtype=torch.uint8), "proprio": torch.zeros(5, 4)}
        >>> likelihood.target(observation).shape
        torch.Size([5, 196])
    """

    rank = 1

    def __init__(self, parts: dict[str, Likelihood]) -> None:
        self.parts = {name: parts[name] for name in sorted(parts)}
        self.name = ",".join(f"{name}={part.name}" for name, part in self.parts.items())
        self._shapes: dict[str, tuple[int, ...]] = {}

    def for_shape(self, shapes: Shape) -> "PartsLikelihood":
        """Return the likelihood of parts of these shapes.

        Raises:
            ForbesError: if the observations have other parts, or a part another rank than its likelihood.
        """
        bound = PartsLikelihood(self.parts)
        bound._shapes = _shapes(shapes, self.parts, "likelihood")
        for name, shape in bound._shapes.items():
            if self.parts[name].rank != len(shape):
                raise ForbesError(
                    f"PartsLikelihood: that of {name} is a {type(self.parts[name]).__name__}, of observations of rank "
                    f"{self.parts[name].rank}, found shape {shape}. Choose another in model.likelihood"
                )
        return bound

    def check(self, observation: Observed) -> None:
        """See `Likelihood.check`."""
        for name, part in self.parts.items():
            part.check(observation[name])

    def target(self, observation: Observed) -> Tensor:
        """See `Likelihood.target`: the targets of the parts, `(*, O)`."""
        return self._joined({name: part.target(observation[name]) for name, part in self.parts.items()})

    def picture(self, observation: Observed) -> Tensor:
        """See `Likelihood.picture`, `(*, O)`."""
        return self._joined({name: part.picture(observation[name]) for name, part in self.parts.items()})

    def mean(self, output: Tensor) -> Tensor:
        """See `Likelihood.mean`, `(*, O)`."""
        outputs = self.split(output)
        return self._joined({name: part.mean(outputs[name]) for name, part in self.parts.items()})

    def sample(self, output: Tensor) -> Tensor:
        """See `Likelihood.sample`, `(*, O)`."""
        outputs = self.split(output)
        return self._joined({name: part.sample(outputs[name]) for name, part in self.parts.items()})

    def log_prob(self, output: Tensor, target: Tensor) -> Tensor:
        """See `Likelihood.log_prob`."""
        return sum_of_parts(self.log_prob_by_part(output, target))

    def log_prob_by_part(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """See `Likelihood.log_prob_by_part`."""
        outputs, targets = self.split(output), self.split(target)
        return {name: part.log_prob(outputs[name], targets[name]) for name, part in self.parts.items()}

    def images(self, values: Tensor) -> Tensor:
        """See `Likelihood.images`: the parts that are images, side by side; vectors are left out."""
        return side_by_side([part for part in self.split(values).values() if part.ndim == values.ndim + 2])

    def split(self, values: Tensor) -> dict[str, Tensor]:
        """Return the parts of a target, an output, a mean or a picture: `(*, O)` to `(*, *O_i)` by name."""
        if not self._shapes:
            raise ForbesError("PartsLikelihood: the shapes of its parts are unknown. Call for_shape")
        return _split(values, self._shapes)

    def _joined(self, parts: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([part.flatten(-self.parts[name].rank) for name, part in parts.items()], -1)  # (*, O)


class PartsEncoder(Encoder):
    """One encoder for each part, whose embeddings are joined.

    Args:
        observation_shape: shapes of the parts by name.
        parts: class of the encoder of each part, with its arguments.

    Raises:
        ForbesError: if the observations have other parts.

    Example:
        >>> parts = {"camera": forbes.ConvEncoder, "proprio": forbes.MLPEncoder.configured(width=16)}
        >>> encoder = forbes.PartsEncoder({"camera": (3, 8, 8), "proprio": (4,)}, parts)
        >>> encoder(torch.zeros(7, 3 * 8 * 8 + 4)).shape
        torch.Size([7, 304])
    """

    def __init__(self, observation_shape: Shape, parts: dict[str, EncoderFamily]) -> None:
        super().__init__()
        self.shapes = _shapes(observation_shape, parts, "encoder")
        self.encoders = nn.ModuleList(parts[name](shape) for name, shape in self.shapes.items())
        self.embedding_dim = sum(encoder.embedding_dim for encoder in self._encoders())

    def forward(self, observation: Tensor) -> Tensor:
        """See `Encoder`: targets of a `PartsLikelihood` `(N, O)` to `(N, E)`."""
        parts = _split(observation, self.shapes).values()
        return torch.cat([encoder(part) for encoder, part in zip(self._encoders(), parts, strict=True)], -1)  # (N, E)

    def _encoders(self) -> Iterable[Encoder]:
        return self.encoders  # type: ignore[return-value]


class PartsDecoder(Decoder):
    """One decoder for each part, whose outputs stand one after the other, flat.

    Args:
        feature_dim: F.
        observation_shape: shapes of the parts by name.
        parts: class of the decoder of each part, with its arguments.

    Raises:
        ForbesError: if the observations have other parts.

    Example:
        >>> parts = {"camera": forbes.ConvDecoder, "proprio": forbes.MLPDecoder}
        >>> decoder = forbes.PartsDecoder(30, {"camera": (3, 8, 8), "proprio": (4,)}, parts)
        >>> decoder(torch.zeros(7, 30)).shape
        torch.Size([7, 196])
    """

    def __init__(self, feature_dim: int, observation_shape: Shape, parts: dict[str, DecoderFamily]) -> None:
        super().__init__()
        self.shapes = _shapes(observation_shape, parts, "decoder")
        self.size = size_of(self.shapes)
        self.decoders = nn.ModuleList(parts[name](feature_dim, shape) for name, shape in self.shapes.items())

    def forward(self, features: Tensor) -> Tensor:
        """See `Decoder`: `(N, F)` to `(N, O)`."""
        return torch.cat([decoder(features).flatten(1) for decoder in self.decoders], -1)  # (N, O)


def side_by_side(images: Sequence[Tensor]) -> Tensor:
    """Join images `(*, C_i, H_i, W_i)` to one as high as the highest, `(*, C, H, sum W_i)`; below lower ones it is 0.

    One channel stays one if all have one. Otherwise there are three: two channels are red and cyan, of four the last is
    left out.
    """
    height = max(image.shape[-2] for image in images)
    if any(image.shape[-3] > 1 for image in images):
        channels = {1: [0, 0, 0], 2: [0, 1, 1]}
        images = [image[..., channels.get(image.shape[-3], [0, 1, 2]), :, :] for image in images]
    return torch.cat([pad(image, (0, 0, 0, height - image.shape[-2])) for image in images], -1)


def _split(values: Tensor, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Return the parts of `(*, O)` by name, `(*, *O_i)`."""
    pieces = values.split([size_of(shape) for shape in shapes.values()], -1)
    return {name: piece.unflatten(-1, shape) for piece, (name, shape) in zip(pieces, shapes.items(), strict=True)}


def _shapes(shapes: Shape, parts: Iterable[str], role: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the parts in the order of their names, where there is something of this role for each."""
    if not isinstance(shapes, Mapping):
        raise ForbesError(
            f"Parts{role.capitalize()}: found observations of shape {(*shapes,)}, expected several parts. Use "
            f"the {role} of one part as model.{role}"
        )
    if {*shapes} != {*parts}:
        missing, unknown = sorted({*shapes} - {*parts}), sorted({*parts} - {*shapes})
        problem = " and ".join(
            f"{what} {', '.join(names)}" for what, names in (("lacks", missing), ("has", unknown)) if names
        )
        raise ForbesError(
            f"Parts{role.capitalize()}: {problem}, but the observations have {', '.join(sorted(shapes))}. Name one "
            f"{role} for each in model.{role}"
        )
    return {name: tuple(shapes[name]) for name in sorted(shapes)}
