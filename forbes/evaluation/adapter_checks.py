r"""Check what a model that was trained elsewhere promises: shapes, one seed, causality, and normalised densities.

A few sequences suffice. Densities of states are checked by importance weights, whose mean is at most 1:

.. math:: E_q\!\left[\frac{p(s_t \mid h_t)}{q(s_t \mid h_t, e_t)}\right] \le 1, \qquad
          P\!\left(\text{mean} \ge 1000\right) \le \tfrac{1}{1000} \quad \text{(Markov)}

An own likelihood is summed over all symbols, or compared with a normalised g that was fitted to its samples,
:math:`E_p[g(o) / p(o)] = 1`, where observations have few dimensions.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.distributions import Normal as Gaussian

from forbes.data import SequenceData, Split
from forbes.errors import ForbesError
from forbes.models import (
    BeliefModel,
    Bernoulli,
    EncodedSequence,
    Likelihood,
    ModelAdapter,
    Normal,
    OneHot,
    OnePixel,
    PartsLikelihood,
    State,
    VectorNormal,
    has_posterior,
)
from forbes.seeding import forked
from forbes.shapes import Observed, map_parts

__all__ = ["check_model"]

_ROWS, _STEPS = 4, 8
_SPLITS: tuple[Split, ...] = ("test", "validation", "train")
_LARGEST_WEIGHT = 1000.0
_DRAWS, _DIMS = 4000, 64
"""Samples of an own likelihood, and the largest dimension of an observation for which they say enough."""
_UNITS: dict[int, dict[str, Likelihood]] = {
    3: {"normal": Normal(), "bernoulli": Bernoulli(), "categorical": OnePixel()},
    1: {"normal": VectorNormal(), "categorical": OneHot()},
}
"""Likelihoods of forbes by rank and name: scores of one name are of the same quantity."""


@torch.no_grad()
def check_model(model: BeliefModel, data: SequenceData, where: str, needs: Sequence[str] = ()) -> None:
    """Check a model in eval mode on the first sequences of its data.

    Args:
        model: the model, on any device.
        data: data that it is evaluated on.
        where: name of the model, for error messages.
        needs: methods that the likelihood must have, of `sample` and `mean`.

    Raises:
        ForbesError: if the model does not do what `ModelAdapter` asks for; says which method, and what it returns.
    """
    split: Split = next((split for split in _SPLITS if data.source.size(split)), "train")
    rows = torch.arange(min(_ROWS, data.source.size(split)))
    batch = data.sequences(split, rows, min(_STEPS, data.length)).to(next(model.parameters()).device)
    if not isinstance(getattr(model, "likelihood", None), Likelihood):
        raise ForbesError(f"{where}: has no likelihood. Set it to what decode_state returns, e.g. forbes.Normal()")
    observation, action = batch.observation, batch.action
    _check_likelihood(model.likelihood, observation, where)
    model.likelihood.check(batch.observed)
    if isinstance(model, ModelAdapter):
        _check_methods(model, observation, action.clone(), where)
    encoded = model.encode(observation, action)
    kept = EncodedSequence(*(values.clone() for values in encoded))
    first, again = (_seeded(model.predictive_log_prob, encoded, model.log_likelihood) for _ in range(2))
    _require_shape(first, tuple(batch.mask.shape), "predictive_log_prob", where)
    if not all(map(torch.equal, encoded, kept)):
        raise ForbesError(f"{where}: changes its arguments in place, e.g. action *= …. Write action = action * …")
    if not _close(first, again):
        raise ForbesError(
            f"{where}: gives other numbers for the same seed. Draw all noise from torch's global generator"
        )
    _check_causality(model, observation, action, where)
    if has_posterior(model):
        _check_weights(model, encoded, where)
    _check_normalised(model, encoded, where)
    output = model.decode(torch.cat(model.sample_beliefs(encoded, 1), -1))  # (B, *P)
    for name in needs:
        try:
            getattr(model.likelihood, name)(output)
        except NotImplementedError as error:
            raise ForbesError(f"{where}: its likelihood has no {name}, which is needed here. Implement it") from error


def _check_methods(model: ModelAdapter, observation: Observed, action: Tensor, where: str) -> None:
    """Check what each method returns for one step."""
    rows, start = len(action), model.initial(len(action))
    _require_state(start, None, rows, "initial", where)
    widths = (start.hidden.shape[-1], start.state.shape[-1])
    target = model.likelihood.target(observation)
    embedding = model.embed_target(target)
    if embedding.ndim != 3 or embedding.shape[:2] != action.shape[:2]:
        _refuse("embed_target", embedding, f"({rows}, {action.shape[1]}, E)", where)
    if model.has_densities:
        hidden = model.advance(start, action[:, 0])
        _require_shape(hidden, (rows, widths[0]), "advance", where)
        _require_distribution(model.prior(hidden), rows, widths[1], "prior", where)
        _require_distribution(model.posterior(hidden, embedding[:, 0]), rows, widths[1], "posterior", where)
    states = {"predict": model.predict(start, action[:, 0])}
    if model.has_steps:
        states["observe"] = model.observe(start, action[:, 0], embedding[:, 0])
    for method, state in states.items():
        _require_state(state, widths, rows, method, where)
        if model.has_densities and not _close(state.hidden, hidden):
            raise ForbesError(f"{where}: the hidden state of {method} is not that of advance, expected the same")
    _require_state(model.beliefs(embedding, action), widths, action.shape[:2], "beliefs", where)
    output = model.decode_state(states["predict"])
    if _is_ours(model.likelihood):
        _require_shape(output, (rows, *target.shape[2:]), "decode_state", where)
    log_prob = model.log_likelihood(torch.cat(states["predict"], -1).expand(2, rows, -1), target[:, 0])
    _require_shape(log_prob, (2, rows), "the log-likelihood", where)


def _check_causality(model: BeliefModel, observation: Observed, action: Tensor, where: str) -> None:
    """Exchange what follows a step, and then the other sequences; neither may change the belief after it."""
    drawn = _belief(model, observation, action)
    steps = action.shape[1]
    for seen in {1, steps // 2, steps - 1} - {0, steps}:
        later = torch.arange(steps, device=action.device) >= seen  # (T,)
        exchanged = map_parts(partial(_exchanged, later=later), observation)
        other = _belief(model, exchanged, _exchanged(action, later))
        if not _close(drawn[:, :seen], other[:, :seen]):
            raise ForbesError(
                f"{where}: the belief after {seen} of {steps} steps depends on later observations, expected those so "
                "far only. Look for a smoother, attention without a causal mask, or statistics over time in the encoder"
            )
    changed = map_parts(lambda values: torch.cat((values[:1], values[1:].flip(1))), observation)
    if not _close(drawn[:1], _belief(model, changed, action)[:1]):
        raise ForbesError(
            f"{where}: the belief of a sequence depends on the others of its batch. Look for batch norm in train mode"
        )


def _belief(model: BeliefModel, observation: Observed, action: Tensor) -> Tensor:
    """Return draws of the belief after each step, `(B, T, F)`; else the log-likelihood of the step, `(B, T, 1)`."""
    encoded = model.encode(observation, action.clone())
    if isinstance(model, ModelAdapter):
        drawn: Tensor = torch.cat(_seeded(model.beliefs, encoded.embedding, encoded.action), -1)
        return drawn
    log_prob: Tensor = _seeded(model.predictive_log_prob, encoded, model.log_likelihood)[..., None]
    return log_prob


def _exchanged(values: Tensor, later: Tensor) -> Tensor:
    """Replace the steps where `later`, `(T,)`, is True by those of another sequence of the batch, `(B, T, ...)`."""
    return torch.where(later.view(1, -1, *[1] * (values.ndim - 2)), values.roll(1, 0), values)


def _check_weights(model: BeliefModel, encoded: EncodedSequence, where: str) -> None:
    """Check the densities of prior and posterior by the mean of their ratio under each of them."""
    assert has_posterior(model)
    with forked(encoded.action.device, 0):
        filtered = model.filter(encoded.embedding, encoded.action)
        state, log_prior = model.sample_prior(filtered)
        ratios = {
            "p / q under q": model.prior_log_prob(filtered) - filtered.log_prob,
            "q / p under p": model.posterior_log_prob(state, filtered) - log_prior,
        }
    for name, log_ratio in ratios.items():
        if log_ratio.isnan().any():
            raise ForbesError(f"{where}: the densities of prior and posterior give NaN, expected nats")
        log_mean = log_ratio.double().logsumexp((0, 1)).item() - math.log(log_ratio.numel())
        if log_mean > math.log(_LARGEST_WEIGHT):
            raise ForbesError(
                f"{where}: the mean of {name} is e^{log_mean:.0f}, expected at most 1. A density of prior or posterior "
                "is not that of its samples, or not normalised"
            )


def _check_likelihood(likelihood: Likelihood, observation: Observed, where: str) -> None:
    """Check that an own likelihood with the name of one of forbes is about the same values."""
    if isinstance(observation, Mapping):
        if not isinstance(likelihood, PartsLikelihood) or {*likelihood.parts} != {*observation}:
            raise ForbesError(
                f"{where}: its likelihood is a {type(likelihood).__name__}, expected forbes.PartsLikelihood with the "
                f"parts of the data, {', '.join(observation)}"
            )
        return
    rank, name = observation.ndim - 2, likelihood.name.partition("(")[0]
    if likelihood.rank != rank:
        raise ForbesError(
            f"{where}: its likelihood is one of observations with {likelihood.rank} dimensions, the data have {rank}"
        )
    ours = _UNITS.get(rank, {}).get(name)
    if ours is None or _is_ours(likelihood):
        return
    target, expected = likelihood.target(observation), ours.target(observation)
    if target.shape != expected.shape or not _close(target, expected):
        raise ForbesError(
            f"{where}: its likelihood is called {likelihood.name}, but its target is in other units than that of "
            f"forbes.{type(ours).__name__}. Rename it, since scores of one name are compared"
        )


def _check_normalised(model: BeliefModel, encoded: EncodedSequence, where: str) -> None:
    """Check that an own likelihood of few dimensions sums or integrates to 1."""
    likelihood, target = model.likelihood, encoded.target
    dims = math.prod(target.shape[2:])
    if _is_ours(likelihood) or dims > _DIMS:
        return
    with forked(target.device, 0):
        belief = model.sample_beliefs(encoded, 1)
        output = model.decode(torch.cat(belief, -1)[:1])  # (1, *P)
        one_hot = target.ndim == 3 and bool(((target == 0) | (target == 1)).all() and (target.sum(-1) == 1).all())
        if one_hot:
            symbols = torch.eye(dims, device=target.device)
            total = likelihood.log_prob(output.expand(dims, *output.shape[1:]), symbols).exp().sum().item()
            tolerance = 1e-3
        else:
            try:
                drawn = likelihood.sample(output.expand(_DRAWS, *output.shape[1:]))
            except NotImplementedError:
                return
            log_prob = likelihood.log_prob(output.expand(_DRAWS, *output.shape[1:]), drawn).double()
            total, tolerance = _integral(drawn.flatten(1).double(), log_prob)
    if abs(total - 1) > tolerance:
        raise ForbesError(
            f"{where}: its likelihood {likelihood.name} integrates to {total:.3g}, expected 1. A constant is "
            "missing, or sample does not draw from it"
        )


def _integral(drawn: Tensor, log_prob: Tensor) -> tuple[float, float]:
    """Estimate the integral of a density from samples `(M, D)` and log-densities `(M,)`, and its tolerance.

    A product of Gaussians or Bernoullis is fitted to one half, and compared with the density on the other. The
    tolerance is infinite where too few samples carry the estimate.
    """
    half = len(drawn) // 2
    fit, rest = drawn[:half], drawn[half:]
    g: Distribution
    if ((drawn == 0) | (drawn == 1)).all():
        g = torch.distributions.Bernoulli(fit.mean(0).clamp(1 / half, 1 - 1 / half))
    else:
        g = Gaussian(fit.mean(0), fit.std(0).clamp(min=1e-9))
    log_g: Tensor = g.log_prob(rest)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    log_weight = log_g.sum(1) - log_prob[half:]  # (M / 2,)
    scaled = (log_weight - log_weight.max()).exp()
    effective = scaled.sum().square() / scaled.square().sum()
    if effective < half / 10:
        return 1.0, math.inf
    inverse = scaled.mean() * log_weight.max().exp()
    return 1 / inverse.item(), 5 * (scaled.std() / scaled.mean()).item() / math.sqrt(half) / inverse.item() + 1e-3


def _seeded(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function with the noise of seed 0."""
    device = next(argument.device for argument in _tensors(arguments))
    with forked(device, 0):
        return function(*arguments)


def _tensors(arguments: tuple[Any, ...]) -> list[Tensor]:
    """Return the tensors among some arguments and in their records."""
    flat = [part for argument in arguments for part in (argument if isinstance(argument, tuple) else (argument,))]
    return [part for part in flat if isinstance(part, Tensor)]


def _close(one: Tensor, other: Tensor) -> bool:
    return torch.allclose(one.double(), other.double(), rtol=1e-4, atol=1e-5)


def _is_ours(likelihood: Likelihood) -> bool:
    return type(likelihood).__module__.startswith("forbes.")


def _require_state(
    state: object, widths: tuple[int, int] | None, rows: int | torch.Size, method: str, where: str
) -> None:
    if not isinstance(state, State):
        raise ForbesError(f"{where}: {method} returns a {type(state).__name__}, expected forbes.State(hidden, state)")
    leading = (rows,) if isinstance(rows, int) else tuple(rows)
    for name, values, width in zip(state._fields, state, widths or (None, None), strict=True):
        expected = (*leading, values.shape[-1] if width is None else width)
        _require_shape(values, expected, f"the {name} of {method}", where)


def _require_shape(values: Tensor, expected: tuple[int, ...], what: str, where: str) -> None:
    if not isinstance(values, Tensor) or tuple(values.shape) != expected:
        _refuse(what, values, str(expected), where)
    if not values.isfinite().all():
        raise ForbesError(f"{where}: {what} is not finite. The checkpoint is damaged, or the training diverged")


def _require_distribution(distribution: object, rows: int, width: int, method: str, where: str) -> None:
    if not isinstance(distribution, Distribution):
        kind = type(distribution).__name__
        raise ForbesError(f"{where}: {method} returns a {kind}, expected a torch.distributions.Distribution")
    batch, event = tuple(distribution.batch_shape), tuple(distribution.event_shape)
    if batch != (rows,) or math.prod(event) != width:
        raise ForbesError(
            f"{where}: {method} returns a distribution of batch shape {batch} and event shape {event}, expected "
            f"({rows},) and {width} numbers. Wrap it: torch.distributions.Independent(distribution, 1)"
        )


def _refuse(what: str, values: object, expected: str, where: str) -> None:
    found = tuple(values.shape) if isinstance(values, Tensor) else f"a {type(values).__name__}"
    raise ForbesError(f"{where}: {what} has shape {found}, expected {expected}")
