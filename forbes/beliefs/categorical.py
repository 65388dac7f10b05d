"""The categorical belief of DreamerV2 (Hafner et al., 2021, arXiv 2010.02193) and DreamerV3 (arXiv 2301.04104)."""

import math

import torch
from torch import Tensor, nn

from forbes.beliefs.base import BeliefHead
from forbes.errors import ForbesError, require_at_least

__all__ = ["CategoricalBelief", "draw_one_hot", "one_hot_of"]


class CategoricalBelief(BeliefHead):
    r"""G independent one-hot variables of K classes each; s is their concatenation, of dimension D = G K.

    .. math:: p(s \mid c) = \prod_{g=1}^G \prod_{k=1}^K \pi_{gk}(c)^{s_{gk}}, \qquad
              \pi_g = (1 - m)\,\mathrm{softmax}(\cdot) + m / K

    This is a probability, not a density. Gradients are straight-through, :math:`\partial s := \partial \pi` (DreamerV2,
    algorithm 1). They are unbiased for functions that are linear in each variable, such as log p, and biased otherwise.

    Args:
        state_dim: D, a multiple of `classes`; 1024 in DreamerV2.
        context_dim: C, the dimension of the context.
        classes: K; 32 as in DreamerV2.
        kl_balance: :math:`\alpha` in [0, 1], weight of the prior's gradient in the closed-form KL, with
            :math:`1 - \alpha` for the posterior's; 0.8 in DreamerV2. Or both weights, that of the prior first; 1 and
            0.1 in DreamerV3. By default, prior and posterior both receive their full gradient.
        uniform_mix: m in [0, 1), weight of the uniform distribution; 0.01 in DreamerV3. It bounds the KL by
            :math:`G \log(K / m)` nats.

    Raises:
        ForbesError: when `classes` is below 1, `state_dim` not a multiple of it, or a weight outside its interval.

    Example:
        >>> belief = forbes.CategoricalBelief(state_dim=2, context_dim=8, classes=2)
        >>> state, log_prob = belief.rsample(torch.zeros(5, 8), sample_shape=(100,))
        >>> state.shape, log_prob.shape
        (torch.Size([100, 5, 2]), torch.Size([100, 5]))
    """

    reparameterised = False

    def __init__(
        self,
        state_dim: int,
        context_dim: int,
        classes: int = 32,
        kl_balance: float | tuple[float, float] | None = None,
        uniform_mix: float = 0.0,
    ) -> None:
        super().__init__(state_dim, context_dim)
        require_at_least(1, "CategoricalBelief", classes=classes)
        if state_dim % classes:
            raise ForbesError(f"CategoricalBelief: state_dim is {state_dim}, expected a multiple of classes, {classes}")
        if not 0 <= uniform_mix < 1:
            raise ForbesError(f"CategoricalBelief: uniform_mix is {uniform_mix}, expected 0 to below 1. Use 0.01")
        self.classes, self.uniform_mix = classes, uniform_mix
        self.kl_weights = _kl_weights(kl_balance)
        self.logits_of = nn.Linear(context_dim, state_dim)

    def log_probabilities(self, context: Tensor) -> Tensor:
        """Return log π, `(*, G, K)`."""
        variables: Tensor = self.logits_of(context).unflatten(-1, (-1, self.classes))  # (*, G, K)
        log_softmax = variables.log_softmax(-1)
        if not self.uniform_mix:
            return log_softmax
        uniform = log_softmax.new_full((), math.log(self.uniform_mix / self.classes))
        return torch.logaddexp(log_softmax + math.log1p(-self.uniform_mix), uniform)

    def rsample(self, context: Tensor, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """See `BeliefHead.rsample`; the gradient is straight-through."""
        return draw_one_hot(self.log_probabilities(context), sample_shape)

    def log_prob(self, state: Tensor, context: Tensor) -> Tensor:
        """See `BeliefHead.log_prob`; the states are one-hot."""
        return (state * self.log_probabilities(context).flatten(-2)).sum(-1)

    def kl(self, context: Tensor, prior: BeliefHead, prior_context: Tensor) -> Tensor | None:
        r"""See `BeliefHead.kl`; the closed form exists if both are categorical with the same number of classes.

        .. math:: \sum_{g,k} \pi_{gk} (\log \pi_{gk} - \log \pi^{prior}_{gk})

        With `kl_balance` its gradient is that of :math:`\alpha\, KL(\mathrm{sg}(q) \| p) +
        \beta\, KL(q \| \mathrm{sg}(p))`, with :math:`\beta = 1 - \alpha` unless given (DreamerV2, algorithm 2;
        DreamerV3, equation 4); its value is unchanged.
        """
        if not isinstance(prior, CategoricalBelief) or prior.classes != self.classes:
            return None
        ours, theirs = self.log_probabilities(context), prior.log_probabilities(prior_context)  # 2 x (*, G, K)
        if self.kl_weights is not None:
            of_prior, of_posterior = self.kl_weights
            ours, theirs = _scale_gradient(ours, of_posterior), _scale_gradient(theirs, of_prior)
        return (ours.exp() * (ours - theirs)).sum((-2, -1))


def one_hot_of(index: Tensor, like: Tensor) -> Tensor:
    """Return one-hot rows like `like`, `(*, K)`, of an index, `(*, 1)`; unlike `one_hot`, without reading values."""
    return torch.zeros_like(like).scatter(-1, index, 1.0)


def _kl_weights(kl_balance: float | tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the weights of the gradients of prior and posterior; None where both are 1."""
    if kl_balance is None:
        return None
    of_prior, of_posterior = (kl_balance, 1 - kl_balance) if isinstance(kl_balance, int | float) else kl_balance
    if not (0 <= of_prior <= 1 and 0 <= of_posterior <= 1):
        raise ForbesError(
            f"CategoricalBelief: kl_balance is {kl_balance}, expected 0 to 1. DreamerV2 has 0.8, DreamerV3 (1, 0.1)"
        )
    return of_prior, of_posterior


def _scale_gradient(x: Tensor, factor: float) -> Tensor:
    """Return x with its gradient scaled by a factor."""
    return torch.lerp(x.detach(), x, factor)


def draw_one_hot(log_probability: Tensor, sample_shape: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
    """Sample one-hot variables with straight-through gradients.

    Args:
        log_probability: log π, `(*, G, K)`.
        sample_shape: shape of the independent samples.

    Returns:
        The concatenated variables, `(*sample_shape, *, G K)`, and their joint log-probability in nats,
        `(*sample_shape, *)`.
    """
    # The argmax of log π - log E, E ~ Exp(1), is k with probability π_k. No call here waits for the device.
    shape = (*sample_shape, *log_probability.shape)  # (*sample_shape, *, G, K)
    race = log_probability.new_empty(shape).exponential_().log()
    drawn = one_hot_of((log_probability.detach() - race).argmax(-1, keepdim=True), race)  # (*sample_shape, *, G, K)
    probability = log_probability.exp()
    state = (drawn + (probability - probability.detach())).flatten(-2)  # (*, D)
    return state, (state * log_probability.flatten(-2)).sum(-1)
