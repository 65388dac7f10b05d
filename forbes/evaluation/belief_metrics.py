r"""Scores of beliefs as `torchmetrics.Metric`s, to log from any `LightningModule`, on one device or several.

Their states are sums in float64, reduced over devices by addition. So several devices, or several batches of any sizes,
give the value that one batch of all sequences would. The inputs are log-probabilities, from any model.
"""

import math
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from forbes.errors import ForbesError, require_at_least

__all__ = ["ELBO", "PLL", "CalibrationError"]


class _MeanOverSequences(Metric):
    """The mean over sequences of a sum over steps."""

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    total: Tensor
    sequences: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("sequences", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def compute(self) -> Tensor:
        """Return the mean over all sequences, in nats per sequence, a float64 scalar."""
        return self.total / self.sequences

    def _add(self, values: Tensor, mask: Tensor) -> None:
        """Add the steps that count, both `(B, T)`."""
        if values.shape != mask.shape:
            raise ForbesError(
                f"{type(self).__name__}: the values have shape {tuple(values.shape)} and the mask {tuple(mask.shape)}, "
                "expected (B, T) for both. Give one value per step"
            )
        self.total += values.detach().double().where(mask, 0.0).sum()  # padding may be infinite
        self.sequences += len(values)


class ELBO(_MeanOverSequences):
    r"""Evidence lower bound of a latent sequence model, in nats per sequence; higher is better.

    .. math:: \frac1N \sum_n \sum_t \log p(o_t \mid h_t, s_t) - \log \frac{q(s_t \mid h_t, e_t)}{p(s_t \mid h_t)},
              \qquad s_t \sim q

    Free nats and weights of the KL have no place here: the value is a bound of the log-evidence only without them.

    Args:
        **kwargs: arguments of `torchmetrics.Metric`.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
        >>> terms = forbes.WorldModel.for_data(data).terms(data.sequences("test", torch.arange(8)))
        >>> elbo = forbes.ELBO()  # in a LightningModule: self.elbo = forbes.ELBO()
        >>> elbo.update(terms.reconstruction, terms.kl, terms.mask)  # (8, 30) each
        >>> bool(torch.isclose(elbo.compute(), terms.elbo.double().mean()))  # self.log("val/elbo", self.elbo)
        True
    """

    def update(self, log_likelihood: Tensor, kl: Tensor, mask: Tensor) -> None:
        """Add a batch.

        Args:
            log_likelihood: log p(o_t | h_t, s_t) at a posterior sample, in nats, shape `(B, T)`.
            kl: log q(s_t) - log p(s_t) at the same sample, or its expectation, in nats, shape `(B, T)`.
            mask: True where the step counts, shape `(B, T)`.
        """
        self._add(log_likelihood.double() - kl.double(), mask)


class PLL(_MeanOverSequences):
    r"""Prequential log-likelihood, in nats per sequence: a proper score of the filtering belief; higher is better.

    .. math:: \frac1N \sum_n \sum_t \log \frac1K \sum_k p(o_t \mid h_t^k), \qquad h_t^k \sim \text{belief given }
              o_{1:t-1}

    With K samples it is a lower bound of the score of the belief itself, and rises with K (Jensen), so compare models
    at the same K.

    Args:
        **kwargs: arguments of `torchmetrics.Metric`.

    Example:
        >>> pll = forbes.PLL()
        >>> log_prob = torch.tensor([0.2, 0.6]).log()[:, None, None].expand(2, 1, 3)  # K = 2, B = 1, T = 3
        >>> pll.update(log_prob, mask=torch.ones(1, 3, dtype=torch.bool))
        >>> round(pll.compute().item(), 4)  # 3 log 0.4
        -2.7489
    """

    def update(self, log_prob: Tensor, mask: Tensor) -> None:
        """Add a batch.

        Args:
            log_prob: log p(o_t | h_t) of each of K belief samples, in nats, shape `(K, B, T)`.
            mask: True where the step counts, shape `(B, T)`.
        """
        self._add(log_prob.double().logsumexp(0) - math.log(len(log_prob)), mask)


class CalibrationError(Metric):
    r"""Distance of a belief's coverage from the nominal one, between 0 and 1/2; lower is better, and 0 is calibrated.

    .. math:: \int_0^1 \lvert c(a) - a \rvert \, da

    c(a) is the fraction of true states inside the belief's highest-density region of probability a (expected coverage,
    Hermans et al., 2022). It follows from the rank of log q(s) among the log-densities of L samples of the belief; a
    rank with ties counts in equal parts for all that it may be. The integral is a mean over the midpoints of 100
    intervals. N independent states of a calibrated belief give about :math:`0.31 / \sqrt N`, not 0. Steps of one
    sequence are not independent.

    Args:
        samples: number of samples of each belief, L.
        **kwargs: arguments of `torchmetrics.Metric`.

    Raises:
        ForbesError: if `samples` is below 1.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> state, drawn = torch.randn(1000, generator=generator), torch.randn(99, 1000, generator=generator)
        >>> error = forbes.CalibrationError(samples=99)
        >>> for width in (1.0, 0.5):  # the belief N(0, 1) of a state from N(0, 1), then one that is too narrow
        ...     belief = torch.distributions.Normal(0, width)
        ...     error.update(belief.log_prob(state), belief.log_prob(width * drawn))
        ...     print(f"{error.compute():.2f}")
        ...     error.reset()
        0.00
        0.20
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    counts: Tensor

    def __init__(self, samples: int, **kwargs: Any) -> None:
        require_at_least(1, "CalibrationError", samples=samples)
        super().__init__(**kwargs)
        self.samples = samples
        self.add_state("counts", torch.zeros(samples + 1, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, truth: Tensor, drawn: Tensor) -> None:
        """Add N beliefs.

        Args:
            truth: log q of the true states, shape `(N,)`.
            drawn: log q of the samples of each belief, shape `(L, N)`.

        Raises:
            ForbesError: if the shapes are others, or a log-density is NaN.
        """
        if truth.dim() != 1 or drawn.shape != (self.samples, len(truth)):
            raise ForbesError(
                f"CalibrationError: log q has shape {tuple(truth.shape)} for states and {tuple(drawn.shape)} for "
                f"samples, expected (N,) and ({self.samples}, N). Set samples, or choose one step per sequence"
            )
        if truth.isnan().any() or drawn.isnan().any():
            raise ForbesError(
                "CalibrationError: a log-density is NaN, expected numbers. Find where the belief diverged"
            )
        below, equal = (drawn < truth).sum(0), (drawn == truth).sum(0)  # (N,), (N,)
        rank = torch.arange(self.samples + 1, device=truth.device)[:, None]  # (L + 1, 1)
        possible = (rank >= below) & (rank <= below + equal)  # (L + 1, N)
        self.counts += (possible.double() / (equal + 1)).sum(1)

    def compute(self) -> Tensor:
        """Return the error, a float64 scalar."""
        level = (torch.arange(100, dtype=torch.float64, device=self.counts.device) + 0.5) / 100  # (A,)
        above = torch.arange(self.samples, -1, -1, device=self.counts.device)  # (L + 1,), samples of a higher density
        inside = (level[:, None] * (self.samples + 1) - above).clamp(0, 1)  # (A, L + 1), see `ranks.coverage`
        coverage = inside @ self.counts / self.counts.sum()  # (A,)
        return (coverage - level).abs().mean()
