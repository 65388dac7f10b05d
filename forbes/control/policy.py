"""Actor, critic and reward on the features of a belief sample (paper §3.2, appendix; the actor's head is Dreamer's)."""

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from forbes.beliefs.categorical import draw_one_hot, one_hot_of
from forbes.factors import Discrete, factor_sizes
from forbes.models.networks import MLP
from forbes.performance.fusion import fused
from forbes.symlog import symexp, two_hot

__all__ = ["Actor", "FactoredCategorical", "OneHotCategorical", "Policy", "ScalarHead", "TanhNormal", "TwoHotHead"]

_MODE_SAMPLES = 100
_LOG_2 = math.log(2.0)


class Policy(Protocol):
    """A distribution over actions, with batch shape `(*)`."""

    def rsample(self) -> tuple[Tensor, Tensor]:
        """Sample an action, differentiably, with its log-probability in nats: `(*, A)` and `(*)`."""

    def mode(self) -> Tensor:
        """Return the most probable action, `(*, A)`."""


class TanhNormal:
    r"""The tanh of a Gaussian, with values in (-1, 1), independent over the action's dimensions.

    .. math:: a = \tanh u, \quad u \sim N(\mu, \sigma^2), \qquad
              \log p(a) = \sum_i \log N(u_i; \mu_i, \sigma_i) - 2\,(\log 2 - u_i - \mathrm{softplus}(-2 u_i))

    The subtracted term is :math:`\log(1 - \tanh^2 u)` in a form that does not round to 0.

    Args:
        mean: :math:`\mu`, `(*, A)`.
        std: :math:`\sigma`, `(*, A)`.
    """

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        self.mean, self.std = mean, std

    def rsample(self, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """Sample a, reparameterised, with log p(a): `(*sample_shape, *, A)` and `(*sample_shape, *)`."""
        noise = torch.randn((*sample_shape, *self.mean.shape), dtype=self.mean.dtype, device=self.mean.device)
        return _squeeze(noise, self.mean, self.std)

    def mode(self) -> Tensor:
        """Return the most probable of 100 samples per distribution, `(*, A)`; the mode has no closed form."""
        action, log_prob = self.rsample((_MODE_SAMPLES,))
        best = log_prob.argmax(0)  # (*)
        return action.gather(0, best[None, ..., None].expand(1, *action.shape[1:])).squeeze(0)  # (*, A)


@fused
def _squeeze(noise: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Return tanh(μ + σ ε), `(*, A)`, and its log-probability, `(*)`."""
    before = torch.addcmul(mean, std, noise)  # (*, A)
    density = -0.5 * (noise.square() + math.log(2 * math.pi)) - std.log()
    log_prob = (density - 2 * (_LOG_2 - before - softplus(-2 * before))).sum(-1)  # (*)
    return before.tanh(), log_prob


@fused
def _bounded(numbers: Tensor, min_std: float) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation before the tanh, from (x, y)."""
    mean, std = numbers.chunk(2, -1)  # 2 x (*, A)
    return 5 * torch.tanh(mean / 5), softplus(std + math.log(math.expm1(5))) + min_std


class OneHotCategorical:
    r"""One of A actions, one-hot: :math:`\log p(a) = \sum_i a_i \log \mathrm{softmax}(x)_i`.

    Gradients are straight-through, :math:`\partial a := \partial p` (DreamerV2, arXiv 2010.02193). They are biased
    unless the objective is linear in the action, and exact for the entropy as the mean of :math:`-\log p(a)`.

    Args:
        logits: x, `(*, A)`.
    """

    def __init__(self, logits: Tensor) -> None:
        self.log_probability = logits.log_softmax(-1)  # (*, A)

    def rsample(self) -> tuple[Tensor, Tensor]:
        """See `Policy.rsample`."""
        return draw_one_hot(self.log_probability.unsqueeze(-2))  # of (*, 1, A), one variable

    def mode(self) -> Tensor:
        """See `Policy.mode`."""
        return one_hot_of(self.log_probability.argmax(-1, keepdim=True), self.log_probability)


class FactoredCategorical:
    r"""Several choices at a time, made independently: a concatenation of one-hot vectors, one per factor.

    .. math:: a = [a_1, \dots, a_F], \qquad \log p(a) = \sum_f \log p_f(a_f), \qquad H[p] = \sum_f H[p_f]

    Args:
        factors: the distributions :math:`p_f`.
    """

    def __init__(self, factors: Sequence[Policy]) -> None:
        self.factors = factors

    def rsample(self) -> tuple[Tensor, Tensor]:
        """See `Policy.rsample`."""
        actions, log_probs = zip(*(factor.rsample() for factor in self.factors), strict=True)
        return torch.cat(actions, -1), torch.stack(log_probs).sum(0)  # (*, A), (*)

    def mode(self) -> Tensor:
        """See `Policy.mode`."""
        return torch.cat([factor.mode() for factor in self.factors], -1)  # (*, A)


class Actor(nn.Module):
    r"""The policy q(a | features), a tanh-normal of vectors, close to ±1 at initialisation (Dreamer, appendix A).

    .. math:: \mu = 5 \tanh(x / 5), \qquad \sigma = \mathrm{softplus}(y + \log(e^5 - 1)) + \sigma_{min}

    Of discrete actions it is a `OneHotCategorical`, or with several factors a `FactoredCategorical` of them.

    Args:
        feature_dim: dimensions of the features, F.
        action_dim: dimensions of an action, A.
        width: width of each hidden layer.
        layers: number of hidden layers.
        discrete: whether an action is one of A, one-hot; or the sizes of several one-hot factors.
        min_std: :math:`\sigma_{min}`, 1e-4 in Dreamer.
    """

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        width: int,
        layers: int,
        discrete: Discrete = False,
        min_std: float = 1e-4,
    ) -> None:
        super().__init__()
        self.discrete, self.min_std = discrete, min_std
        self.sizes = factor_sizes(discrete, action_dim)
        self.hidden = MLP(feature_dim, width, layers)
        self.head = nn.Linear(width, action_dim if discrete else 2 * action_dim)

    def forward(self, features: Tensor) -> Policy:
        """Return the policy at features, `(*, F)`."""
        numbers: Tensor = self.head(self.hidden(features))
        if self.sizes:
            factors = [OneHotCategorical(logits) for logits in numbers.split(self.sizes, -1)]
            return FactoredCategorical(factors) if len(factors) > 1 else factors[0]
        return TanhNormal(*_bounded(numbers, self.min_std))


class ScalarHead(nn.Module):
    """A scalar function of the features: the reward, the value v, or the logit of the continuation.

    Args:
        feature_dim: dimensions of the features, F.
        width: width of each hidden layer.
        layers: number of hidden layers.
    """

    def __init__(self, feature_dim: int, width: int, layers: int) -> None:
        super().__init__()
        self.net = nn.Sequential(MLP(feature_dim, width, layers), nn.Linear(width, 1))

    def forward(self, features: Tensor) -> Tensor:
        """Return the scalar, `(*, F)` to `(*)`."""
        number: Tensor = self.net(features).to(features.dtype)
        return number.squeeze(-1)  # (*)

    def error(self, features: Tensor, target: Tensor) -> Tensor:
        r"""Return :math:`\tfrac12 (v(f) - x)^2`, `(*)`: but for a constant, the nats of x under N(v(f), 1).

        Args:
            features: f, `(*, F)`.
            target: x, `(*)`.
        """
        difference: Tensor = self(features) - target  # (*)
        return 0.5 * difference.square()


class TwoHotHead(ScalarHead):
    r"""A scalar as the mean of a categorical over K fixed bins (DreamerV3, Hafner et al., arXiv 2301.04104).

    .. math:: v(f) = \sum_k \pi_k(f)\, b_k, \qquad b_k = \mathrm{symexp}\left(-20 + \tfrac{40\,(k - 1)}{K - 1}\right)

    It is trained by the cross-entropy with the two-hot code of the target, whose gradient does not grow with the
    target's scale. At first all bins are equally probable, so v = 0.

    Args:
        feature_dim: dimensions of the features, F.
        width: width of each hidden layer.
        layers: number of hidden layers.
        bins: K, odd; 255 in DreamerV3.
    """

    bins: Tensor

    def __init__(self, feature_dim: int, width: int, layers: int, bins: int = 255) -> None:
        super().__init__(feature_dim, width, layers)
        self.net[1] = last = nn.Linear(width, bins)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        half = symexp(torch.linspace(0, 20, bins // 2 + 1))
        self.register_buffer("bins", torch.cat((-half.flip(0)[:-1], half)), persistent=False)  # (K,)

    def forward(self, features: Tensor) -> Tensor:
        """Return v, `(*, F)` to `(*)`.

        Each bin is paired with its negative: in a plain sum, terms of up to 5e8 would have to cancel.
        """
        probability = self._logits(features).softmax(-1)  # (*, K)
        more = probability - probability.flip(-1)  # (*, K), of a bin than of its negative
        half = self.bins.shape[0] // 2
        return (more * self.bins)[..., half + 1 :].sum(-1)  # (*)

    def error(self, features: Tensor, target: Tensor) -> Tensor:
        r"""Return :math:`-\sum_k w_k(x) \log \pi_k(f)` in nats, `(*)`, with the two-hot code w of x.

        Args:
            features: f, `(*, F)`.
            target: x, `(*)`; it has no gradient.
        """
        return -(two_hot(target.detach(), self.bins) * self._logits(features).log_softmax(-1)).sum(-1)

    def _logits(self, features: Tensor) -> Tensor:
        logits: Tensor = self.net(features).to(features.dtype)
        return logits  # (*, K)
