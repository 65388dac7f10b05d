"""The T-maze: a sign at the start shows which way to turn at the end."""

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from forbes.errors import ForbesError, require_positive
from forbes.pomdps.hmm import FiniteProcess

__all__ = ["TMaze"]

RIGHT, UP, LEFT, DOWN = range(4)
SIGN_UP, SIGN_DOWN, CORRIDOR, CROSSROAD = range(4)


class TMaze(FiniteProcess):
    r"""A corridor of L steps that ends at a crossroad.

    Its positions and observations::

                        |L + 1|     the goal is up or down, as the sign at 0 shows;
        |0|.|.|.|.|.|.|.|  L  |     observations: sign up, sign down, corridor,
                        |L + 2|     or (at L, L + 1 and L + 2) crossroad

    With probability :math:`\lambda` an action is replaced by a random one of the four. An action into a wall has no
    effect, and L + 1 and L + 2 are never left. The problem is from Bakker (2001); parameters, observations and policy
    are those of Lambrechts et al. (2022, arXiv 2208.03520, `tmaze.py` of *belief-rnn*), who play 3 L / (1 - λ) steps.

    State i is at position i mod (L + 3), with the goal up for i < L + 3. Actions are right, up, left, down. Those of
    `sample` go right with probability 1/2.

    Args:
        length: number of steps to the crossroad, L.
        stochasticity: probability of a random action, :math:`\lambda`, in [0, 1]; 0.2 is the other published setting.

    Example:
        >>> process = forbes.TMaze(length=5)
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    def __init__(self, length: int = 10, stochasticity: float = 0.0) -> None:
        require_positive("TMaze", length=length)
        if not 0 <= stochasticity <= 1:
            raise ForbesError(f"TMaze: stochasticity is {stochasticity}, expected a probability. Choose one in [0, 1]")
        self.length, self.stochasticity = length, stochasticity
        places = length + 3
        walk = torch.stack([one_hot(next_place(length, action), places).double() for action in range(4)])  # (4, P, P)
        walk = (1 - stochasticity) * walk + stochasticity * walk.mean(0)
        seen = torch.full((2, places), CORRIDOR)
        seen[:, 0] = torch.tensor([SIGN_UP, SIGN_DOWN])
        seen[:, length:] = CROSSROAD
        start = torch.zeros(2, places, dtype=torch.float64)
        start[:, 0] = 0.5
        super().__init__(
            initial=start.flatten(),  # (2 P,)
            transition=torch.stack([torch.block_diag(table, table) for table in walk]),  # (4, 2 P, 2 P)
            emission=one_hot(seen.flatten(), 4).double(),  # (2 P, 4)
            policy=torch.tensor([3.0, 1.0, 1.0, 1.0], dtype=torch.float64) / 6,
        )

    def reward(self, state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        """See `Process.reward`: 4 at the goal, -0.1 at the other end and for standing still, else 0 (`tmaze.py`)."""
        before, after = state.argmax(-1), next_state.argmax(-1)  # (*)
        goal = self.length + 1 + torch.tensor([0, self.length + 4], device=state.device)  # up (i < L + 3), and down
        reached = (after.unsqueeze(-1) == goal).any(-1)  # (*)
        lost = (before == after) | self.terminal(next_state) & ~reached
        reward = 4.0 * reached.to(state) - 0.1 * lost.to(state)
        return reward.where(~self.terminal(state), 0.0)

    def terminal(self, state: Tensor) -> Tensor:
        """See `Process.terminal`: L + 1 and L + 2."""
        return state.argmax(-1) % (self.length + 3) > self.length


def next_place(length: int, action: int) -> Tensor:
    """Return the position to which an action leads from each of the L + 3 positions, int64."""
    place = torch.arange(length + 3)
    after = place.clone()
    if action == RIGHT:
        after[:length] += 1
    elif action == LEFT:
        after[1 : length + 1] -= 1
    else:
        after[length] += 1 if action == UP else 2
    return after
