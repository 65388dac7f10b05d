"""A record of tensors is printed in a line: what a user wants to know of it is its shapes."""

import numpy as np
import torch

from forbes.data import Simulated
from forbes.data.episodes.episode import Episode
from forbes.envs import Step
from forbes.models import ElboTerms, Rollout, State
from forbes.pomdps import Tiger, Trajectories


def test_a_batch_is_printed_by_shape_and_dtype():
    source = Simulated(Tiger(), train=2, validation=1, test=1)
    batch = source.decode(source.gather("train", torch.arange(2), 5))

    assert repr(batch) == (
        "SequenceBatch(observation=float32 (2, 5, 2), action=float32 (2, 5, 3), reward=float32 (2, 5), "
        "mask=bool (2, 5), state=float32 (2, 5, 4), ended=bool (2, 5))"
    )


def test_so_are_the_other_records_that_a_user_meets():
    zeros, step = torch.zeros(2, 3, dtype=torch.float64), np.zeros((3, 8, 8), np.uint8)

    assert repr(State(zeros, zeros.bool())) == "State(hidden=float64 (2, 3), state=bool (2, 3))"
    assert repr(Rollout(zeros, zeros, zeros[0])).count("float64") == 3
    assert repr(Trajectories(zeros, zeros, zeros)).startswith("Trajectories(state=float64 (2, 3), ")
    assert repr(ElboTerms(zeros, zeros, None, zeros.bool())).endswith(
        "analytic_kl=None, mask=bool (2, 3), auxiliary={}, parts={})"
    )
    assert repr(Step(step, 1.5)) == (
        "Step(observation=uint8 (3, 8, 8), reward=1.5, terminated=False, truncated=False, frames=1)"
    )
    assert "observation=uint8 (3, 8, 8), " in repr(Episode(step, step, step, True, 2))
    assert repr(State(zeros.to("meta"), zeros)) == "State(hidden=float64 (2, 3) on meta, state=float64 (2, 3))"
