"""FORBES as one writes it first: both flows in the time loop, zuko's transforms, plain modules. The form to beat.

As in Dreamer's published code, the encoder runs before the loop and the decoder after it, once over (B·T). In the
loop, each step calls the transition, the GRU cell, and the networks of prior and posterior. It builds both flows for
its context, as zuko does, samples the posterior's and inverts the prior's. The conditioner is ours, from zuko's parts.
The bound is the same up to rounding.
"""

import copy

import torch
import zuko
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from forbes.beliefs import FlowBelief
from forbes.beliefs.coupling import LOG_SCALE_BOUND, AffineCoupling, LULinear
from forbes.models import ElboTerms, StateSpaceModel

__all__ = ["Textbook"]


class BoundedAffine(zuko.transforms.MonotonicAffineTransform):
    """zuko's affine transform with our bound on the log-scale in place of its own."""

    def __init__(self, shift: Tensor, raw: Tensor) -> None:
        super(zuko.transforms.MonotonicAffineTransform, self).__init__()
        self.shift = shift
        self.log_scale = LOG_SCALE_BOUND * torch.tanh(raw / LOG_SCALE_BOUND)
        self.scale = self.log_scale.exp()


def coupling(ours: AffineCoupling, of_context: nn.Linear, layer: int) -> zuko.flows.GeneralCouplingTransform:
    """Build zuko's coupling with the weights of ours; its first layer reads [x_a, c], as everyone writes it."""
    given, other, width = ours.first.in_features, ours.shift.out_features, ours.first.out_features
    kept = torch.arange(given + other) >= other if layer % 2 else torch.arange(given + other) < given
    theirs = zuko.flows.GeneralCouplingTransform(given + other, of_context.in_features, kept, BoundedAffine)
    rows = slice(layer * width, (layer + 1) * width)
    first, last = nn.Linear(given + of_context.in_features, width), nn.Linear(width, 2 * other)
    with torch.no_grad():
        first.weight.copy_(torch.cat((ours.first.weight, of_context.weight[rows]), 1))
        first.bias.copy_(of_context.bias[rows])
        for part, source in enumerate((ours.shift, ours.log_scale)):  # zuko reads (shift, scale) of each dimension
            last.weight[part::2] = source.weight
            last.bias[part::2] = source.bias
    block = nn.Sequential(nn.ReLU(), copy.deepcopy(ours.inner), nn.ReLU(), copy.deepcopy(ours.outer))
    theirs.hyper = nn.Sequential(first, zuko.nn.Residual(*block), last)
    return theirs


def mixing(ours: LULinear) -> list[zuko.lazy.UnconditionalTransform]:
    """Build zuko's LU layer, which has the diagonal in L, and the shift it lacks."""
    with torch.no_grad():
        lower, upper = ours.triangles()
        diagonal = upper.diagonal()
        factors = (lower * diagonal).tril() + (upper / diagonal[:, None]).triu(1)
    return [
        zuko.lazy.UnconditionalTransform(zuko.transforms.LULinearTransform, factors),
        zuko.lazy.UnconditionalTransform(zuko.transforms.AdditiveTransform, ours.bias.detach().clone()),
    ]


class TextbookFlow(nn.Module):
    """The flow belief from zuko's parts: context to a `NormalizingFlow`."""

    def __init__(self, ours: FlowBelief) -> None:
        super().__init__()
        self.base = copy.deepcopy(ours.base)
        parts = []
        for k, layer in enumerate(ours.flow.couplings):
            parts += mixing(ours.flow.mixings[k - 1]) if k > 0 else []
            parts.append(coupling(layer, ours.flow.context, k))
        self.transform = zuko.lazy.LazyComposedTransform(*parts)

    def forward(self, context: Tensor) -> zuko.distributions.NormalizingFlow:
        """Return the belief given a context."""
        # zuko's transforms go from data to noise, ours from noise to data.
        return zuko.distributions.NormalizingFlow(
            self.transform(context).inv, Independent(Normal(*self.base.moments(context)), 1)
        )


class Textbook(nn.Module):
    """A state-space model in the textbook form, with a copy of a given model's weights.

    Args:
        model: state-space model with flow beliefs, whose weights are copied.
    """

    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__()
        self.model = copy.deepcopy(model)
        self.prior, self.posterior = TextbookFlow(model.prior), TextbookFlow(model.posterior)
        del self.model.prior, self.model.posterior

    def lower_bound(self, observation: Tensor, action: Tensor, mask: Tensor) -> ElboTerms:
        """Estimate the bound as `StateSpaceModel.lower_bound` does, one step after the other."""
        model = self.model
        embedding = model.embed(observation)
        hidden, state = model.initial(len(embedding))
        features, kl = [], []
        for e, a in zip(embedding.unbind(1), action.unbind(1), strict=True):
            hidden = model.gru(model.transition(torch.cat((state, a), -1)), hidden)
            prior = self.prior(model.prior_context(hidden))
            posterior = self.posterior(model.posterior_context(torch.cat((hidden, e), -1)))
            state, log_posterior = posterior.rsample_and_log_prob()
            kl.append(log_posterior - prior.log_prob(state))
            features.append(torch.cat((hidden, state), -1))
        output = model.decode(torch.stack(features, 1))  # (B, T, C, H, W)
        log_likelihood = model.likelihood.log_prob(output, model.likelihood.target(observation))
        return ElboTerms(log_likelihood, torch.stack(kl, 1), None, mask)
