r"""Imagined trajectories: several from each belief, each with its own actions (paper §3.2, algorithm 1).

The start is not among the imagined states. The action that the policy takes in a state leads to the next, and the
reward that comes with it belongs to that next state, as it does in stored sequences. H = 3::

    states       s0 --a0--> s1 --a1--> s2 --a2--> s3
    rewards                 r1         r2         r3
    values                  v1         v2         v3
    returns                 V1         V2                 V1 = r1 + γ[(1 - λ) v2 + λ V2],  V2 = r2 + γ v3
"""

import torch

from forbes.models import Filtered, State, StateSpaceModel
from forbes.performance.precision import full_precision

__all__ = ["belief_samples"]


def belief_samples(model: StateSpaceModel, filtered: Filtered, number: int) -> State:
    """Return N samples of the belief at each step of each sequence, as constants: `(N, B, T, …)`.

    The first is the filter's own trajectory, so that N = 1 is Dreamer.
    """
    with full_precision(filtered.context):
        more, _ = model.posterior.rsample(filtered.context, (number - 1,))  # (N - 1, B, T, D)
    state = torch.cat((filtered.state[None], more)).detach()  # (N, B, T, D)
    return State(filtered.hidden.detach().expand(number, -1, -1, -1), state)
