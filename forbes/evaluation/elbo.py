r"""The evidence lower bound of a finished model on a whole split, by one convention (DESIGN §8).

Observation log-likelihood only, fully normalised, in nats per sequence; no free nats; the Monte-Carlo KL for every
family; S posterior trajectories per sequence; sums in float64. Padding does not count.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.models import StateSpaceModel
from forbes.seeding import derive_seed

__all__ = ["Bound", "Estimate", "evaluate_elbo", "paired_difference", "sample_terms"]


class Bound(NamedTuple):
    """The bound of each sequence and its parts, means over S samples in nats, float64 on the CPU."""

    elbo: Tensor
    """J = reconstruction - KL, `(N,)`."""
    reconstruction: Tensor
    r"""E_q Σ_t log p(o_t | h_t, s_t), `(N,)`."""
    kl: Tensor
    r"""E_q Σ_t log q(s_t) - log p(s_t), `(N,)`."""
    steps: Tensor
    """Steps that are no padding, `(N,)`, float64."""

    def per_step(self) -> "Estimate":
        r"""Average over all steps of all sequences: :math:`\sum_i J_i / \sum_i T_i`, with the error of a ratio."""
        mean = self.elbo.sum() / self.steps.sum()
        residual = (self.elbo - mean * self.steps) / self.steps.mean()  # (N,)
        return Estimate(mean.item(), residual.std().item() / math.sqrt(len(self.elbo)))


class Estimate(NamedTuple):
    """A mean over sequences and its standard error."""

    mean: float
    standard_error: float

    @classmethod
    def of(cls, values: Tensor) -> "Estimate":
        """Average one value per sequence, `(N,)`, N at least 2."""
        return cls(values.mean().item(), values.std().item() / math.sqrt(len(values)))


def paired_difference(first: Bound, second: Bound) -> Estimate:
    """Average the difference first - second of two models' bounds over the same sequences, in nats."""
    return Estimate.of(first.elbo - second.elbo)


_FRAMES = 1000
"""Decoded at a time: the memory stays bounded, and a digit's pixels in the processor's cache (a third less time)."""


def sample_terms(model: StateSpaceModel, batch: SequenceBatch, samples: int) -> tuple[Tensor, Tensor]:
    """Draw the bound's integrand: log p(o_t | h_t, s_t) and log q(s_t) - log p(s_t), each `(S, B, T)` in nats, float64.

    The encoder runs once. Each trajectory is filtered and decoded on its own, so the memory is that of one.
    """
    embedding = model.embed(batch.observation)  # (B, T, E)
    target = model.likelihood.target(batch.observation).flatten(0, 1)  # (B T, C, H, W)
    reconstruction, kl = [], []
    for _ in range(samples):
        filtered = model.filter(embedding, batch.action)
        features = filtered.features.flatten(0, 1)  # (B T, H + D)
        parts = [
            model.likelihood.log_prob(model.decode(some).float(), true)
            for some, true in zip(features.split(_FRAMES), target.split(_FRAMES), strict=True)
        ]
        reconstruction.append(torch.cat(parts).double().view(batch.mask.shape))  # (B, T)
        kl.append((filtered.log_prob - model.prior_log_prob(filtered)).double())  # (B, T)
    return torch.stack(reconstruction), torch.stack(kl)  # (S, B, T), (S, B, T)


@torch.no_grad()
def evaluate_elbo(
    model: StateSpaceModel,
    batches: Iterable[tuple[int, SequenceBatch]],
    samples: int = 16,
    seed: int = 0,
    device: torch.device | str = "cpu",
    where: str = "the model",
) -> Bound:
    """Estimate the bound of every sequence with S posterior trajectories each.

    Args:
        model: in eval mode, on the device.
        batches: the index of the first sequence of each batch, and the batch on the CPU.
        samples: S.
        seed: of the posterior's noise, which depends on it and on the batches alone.
        device: where to compute.
        where: the model's and the split's name, for an error.

    Raises:
        ForbesError: where a bound is not finite; it names the sequence.
    """
    parts: list[Bound] = []
    devices = [torch.device(device)] if torch.device(device).type == "cuda" else []
    with torch.random.fork_rng(devices):
        for first, on_cpu in batches:
            torch.manual_seed(derive_seed(seed, "evaluation", first))
            batch = SequenceBatch(*(values.to(device) for values in on_cpu))
            reconstruction, kl = (terms.mean(0) * batch.mask for terms in sample_terms(model, batch, samples))
            bound = Bound((reconstruction - kl).sum(1), reconstruction.sum(1), kl.sum(1), batch.mask.sum(1).double())
            parts.append(Bound(*(values.cpu() for values in bound)))  # 4 x (B,)
            _require_finite(where, first, parts[-1].elbo)
    return Bound(*(torch.cat(values) for values in zip(*parts, strict=True)))  # 4 x (N,)


def _require_finite(where: str, first: int, elbo: Tensor) -> None:
    broken = torch.nonzero(~elbo.isfinite())
    if len(broken):
        place = int(broken[0])
        raise ForbesError(
            f"{where}: the ELBO of sequence {first + place} is {elbo[place].item()}, expected a finite number. "
            "The training diverged: train again with a smaller learning_rate"
        )
