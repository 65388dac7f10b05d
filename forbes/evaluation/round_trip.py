r"""Numerical error of a flow's inverse in float32.

Sampling :math:`s = f(x; c)` gives the log-density of s at x. The log-density of any other state, as under the prior,
needs :math:`f^{-1}(s; c)`. In exact arithmetic the two agree. In float32 they differ where the flow is flat or steep:

.. math:: \max |f^{-1}(f(x; c); c) - x|, \qquad \max |\log q_{draw}(s \mid c) - \log q(s \mid c)|
"""

import sys

import torch
from torch import Tensor

from forbes.beliefs import FlowBelief
from forbes.data import SequenceBatch
from forbes.models import BeliefModel, StateSpaceModel
from forbes.seeding import derive_seed, forked

__all__ = ["LIMIT", "model_round_trip", "print_round_trip", "round_trip"]

LIMIT = 1e-3
"""Difference of the two log-densities in nats above which a warning is printed."""


def round_trip(head: FlowBelief, context: Tensor) -> dict[str, float]:
    """Sample one state from each belief, and return the round-trip error of the flow and its inverse.

    Args:
        head: flow belief.
        context: conditioning vectors c, `(*, C)`.

    Returns:
        `state`, the largest error of the base sample, and `log_prob`, the largest difference of the two log-densities
        in nats. NaN if any value is NaN.
    """
    base, log_base = head.base.rsample(context)  # (*, D), (*)
    state, log_det = head.flow(base, context)
    back, _ = head.flow.inverse(state, context)
    disagreement = log_base - log_det - head.log_prob(state, context)  # (*)
    return {"state": (back - base).abs().max().item(), "log_prob": disagreement.abs().max().item()}


@torch.no_grad()
def model_round_trip(model: BeliefModel, batch: SequenceBatch, seed: int) -> dict[str, dict[str, float]]:
    """Measure the round-trip errors of a model's flows on the beliefs along some sequences.

    Args:
        model: model in eval mode.
        batch: sequences, on any device.
        seed: random seed for the samples.

    Returns:
        Result of `round_trip` for prior and posterior, if they are flows.
    """
    heads = [name for name in ("prior", "posterior") if isinstance(getattr(model, name, None), FlowBelief)]
    if not heads or not isinstance(model, StateSpaceModel):
        return {}
    device = next(model.parameters()).device
    batch = batch.to(device)
    with forked(device, derive_seed(seed, "round trip", 0)):
        filtered = model.filter(model.embed(batch.observation), batch.action)
        contexts = {"prior": model.prior_context(filtered.hidden), "posterior": filtered.context}  # (B, T, C)
        return {name: round_trip(getattr(model, name), contexts[name][batch.mask]) for name in heads}


def print_round_trip(run: str, found: dict[str, dict[str, float]]) -> None:
    """Print the result of `model_round_trip` for a run to stderr, with a warning if it is above `LIMIT`."""
    for name, errors in found.items():
        values = f"state {errors['state']:.1e}, log-density {errors['log_prob']:.1e} nats"
        print(f"{run}: {name} flow, round trip: {values}", file=sys.stderr)
    if any(not errors["log_prob"] <= LIMIT for errors in found.values()):
        print(
            f"WARNING: {run}: the inverse of its flow loses more than {LIMIT:g} nats in float32, so its KL, bounds and "
            "log-densities may be wrong by as much in each step. Train with a smaller width, fewer layers or a lower "
            "learning rate",
            file=sys.stderr,
        )
