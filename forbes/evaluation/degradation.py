"""How much worse a prediction becomes with the horizon: closed loop against open loop, step by step.

Of step t > c the closed loop has seen o_1 to o_{t-1} (`pll`), the open loop o_1 to o_c (`open_loop_marginal`). What
lies between is worth log p(o_t | o_{1:t-1}) - log p(o_t | o_{1:c}), the `degradation`, in nats.
"""

from collections.abc import Mapping, Sequence

import numpy as np

__all__ = ["at_horizons", "degradation"]

_HORIZONS = (1, 2, 5, 10)

Curves = Mapping[str, Mapping[str, Sequence[float]]]
"""By metric, then by model, the mean of each step, `(T,)`."""


def degradation(curves: Curves) -> dict[str, dict[str, list[float]]]:
    """Subtract the open-loop curves from the closed-loop ones of the same sequences; 0 within the context.

    Its name has the numbers of the open loop: `test[:1000]/degradation[bernoulli,K=1000,c=15]`.
    """
    found = {}
    for metric, open_loop in curves.items():
        split, _, tag = metric.partition("/open_loop_marginal[")
        closed_loop = next((name for name in curves if name.startswith(f"{split}/pll[")), None)
        if tag and closed_loop:
            context = _context(metric)
            found[f"{split}/degradation[{tag}"] = {
                name: [0.0] * context + np.subtract(curves[closed_loop][name], curve)[context:].tolist()
                for name, curve in open_loop.items()
            }
    return found


def at_horizons(metric: str, curves: Mapping[str, Sequence[float]]) -> dict[str, dict[int, float]]:
    """Return, by model, what the degradation is 1, 2, 5, 10 steps after the context, and at the end."""
    context = _context(metric)
    end = len(next(iter(curves.values()))) - context
    horizons = [*(horizon for horizon in _HORIZONS if horizon < end), end]
    return {name: {horizon: curve[context + horizon - 1] for horizon in horizons} for name, curve in curves.items()}


def _context(metric: str) -> int:
    return int(metric.rpartition("c=")[2].rstrip("]"))
